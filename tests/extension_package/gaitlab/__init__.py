"""A laboratory's own sensor, stimulator, detector, stride method and file format, for fes."""
