"""How far estimates can be trusted: covariances, profiles, bounds, and estimators held against each other."""
