"""The H-infinity controller for an envelope, tried on the nonlinear model."""
