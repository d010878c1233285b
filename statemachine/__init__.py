"""The four gait phases and the six transitions between them."""
