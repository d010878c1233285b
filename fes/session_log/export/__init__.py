"""A session log for other programs: CSV, Parquet, MCAP. Apart from the journal, which needs none of their libraries."""
