"""Inference: covariances, profiles, bounds, and estimators held against each other."""
