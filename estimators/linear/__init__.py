"""Linear models of many operating conditions at once, by the prediction-error method."""
