"""Calibration: parameters of a machine fitted to recordings through its simulation."""
