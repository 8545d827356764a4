"""Experiment design: the feasible experiment that tells the remaining hypotheses apart."""
