"""The report of a night: what its tables say, as a page with pictures for people."""
