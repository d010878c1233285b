"""Zero-velocity detection, and the filter and smoother aided by it, over a whole recording."""
