"""Functional electrical stimulation timed by how the patient walks."""

__version__ = "0.1.0"
