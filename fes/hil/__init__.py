"""Fault campaigns: a running session, its devices in processes of their own, and the stimulator's end as the judge."""
