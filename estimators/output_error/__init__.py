"""The output-error method: the fit by simulation error."""
