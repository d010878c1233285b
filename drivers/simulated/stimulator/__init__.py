"""Simulated stimulators: their firmware, and the processes that run it."""
