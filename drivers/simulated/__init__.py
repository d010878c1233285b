"""Simulated devices; each owns its end of the line."""
