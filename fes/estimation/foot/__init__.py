"""One foot, live: calibration, orientation, the features that the guards look at, phases and strides."""
