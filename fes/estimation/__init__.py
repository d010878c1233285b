"""From samples to orientation, rest, strides: the numbers behind every decision."""
