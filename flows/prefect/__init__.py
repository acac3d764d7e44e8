"""Prefect: defaults of an embedded server, task runners, what its page shows."""
