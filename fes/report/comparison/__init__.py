"""Sessions side by side, as a page."""
