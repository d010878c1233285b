"""Sources of IMU samples."""
