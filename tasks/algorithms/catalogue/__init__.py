"""Star catalogues: places of stars at a date, and catalogues joined."""
