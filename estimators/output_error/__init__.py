"""The fit by simulation error."""
