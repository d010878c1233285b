"""Initial contact, foot off and foot-strike angle, causal and off-line."""
