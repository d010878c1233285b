"""How true: phases, events, strides, paths, orientation and calibration, on real walks and on virtual ones."""
