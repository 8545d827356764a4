"""Frequency responses of operating conditions, estimated without a model."""
