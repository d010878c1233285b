"""Hemiparetic walks after Wang et al. (2013): zero-velocity windows, paretic side, reconstruction, stairs."""
