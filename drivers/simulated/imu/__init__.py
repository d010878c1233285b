"""Simulated inertial sensors, each in a process of its own."""
