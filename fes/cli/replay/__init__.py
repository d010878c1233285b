"""``fes replay``: a recording or a session log through the same loop as a live session."""
