"""A stride: where it begins and ends, its integration, its numbers."""
