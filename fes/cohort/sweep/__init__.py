"""Many settings tried on recordings or virtual patients."""
