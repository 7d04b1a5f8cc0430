"""The Parquet tables of a run: their columns, how they are written and read."""
