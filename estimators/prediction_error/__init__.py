"""The Kalman predictor of the nonlinear model: its noise, its innovations, and the fit by its likelihood."""
