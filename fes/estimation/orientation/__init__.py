"""Orientation of any moving body, causal and off-line."""
