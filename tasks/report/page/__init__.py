"""The page of the report: HTML of one file, with its sections, tables and pictures."""
