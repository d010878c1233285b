"""How fast: an analysis and its stages, a live step, a session, a day, a cohort; how long late, how much memory."""
