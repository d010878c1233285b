"""Devices: codecs without I/O, thin ports, and simulated devices."""
