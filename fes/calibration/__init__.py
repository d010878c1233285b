"""Calibration of a recording's sensors: how they sit, how this person moves, which foot is which."""
