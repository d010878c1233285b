"""A simulated walker with an IMU on each foot, and the truth beside every sample."""
