"""What the data looks like: tables, log messages, settings and named errors."""
