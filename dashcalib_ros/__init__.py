"""Camera calibration that happens by itself while a car drives."""
