"""The data, unknowns, residual, optimiser and results that every estimator shares."""
