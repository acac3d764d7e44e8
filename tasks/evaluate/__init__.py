"""Comparison of a dataset with the truth of a simulated log."""
