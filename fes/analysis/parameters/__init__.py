"""Gait parameters of a whole recording: per stride and side, their means and spreads, and the two sides compared."""
