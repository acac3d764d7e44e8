"""One thin Prefect task a stage: table in, table out."""
