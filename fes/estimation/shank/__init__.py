"""One shank, live: calibration, lever arm, features, phases and strides without zero velocity."""
