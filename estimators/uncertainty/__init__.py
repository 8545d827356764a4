"""Uncertainty: nominal model, weight, and what makes the weight as large as it is."""
