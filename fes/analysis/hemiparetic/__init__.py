"""Hemiparetic walks after Wang et al. (2013): zero-velocity windows, afflicted side, reconstruction, stairs."""
