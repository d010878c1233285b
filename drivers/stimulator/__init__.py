"""Stimulators: one codec and one thin port per device."""
