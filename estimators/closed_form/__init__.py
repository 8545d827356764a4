"""Least squares in closed form, as in the paper and by modulating functions."""
