"""Logs: MCAP files in and out, with whatever damage they have."""
