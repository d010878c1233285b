"""``fes run``: a live session."""
