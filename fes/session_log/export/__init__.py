"""A session log for other programs: CSV, Parquet, MCAP. The log itself needs none of their libraries."""
