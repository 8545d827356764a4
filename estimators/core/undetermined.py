"""When data leave a combination of parameters free, for fits and for judgements that need no model."""

UNDETERMINED = 10.0
"""Fraction of their size, within one standard deviation, from which on parameters may move along a direction that the data then do
not determine."""
