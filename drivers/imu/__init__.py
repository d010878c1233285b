"""Inertial sensors: one codec without I/O and one thin port per kind of device."""
