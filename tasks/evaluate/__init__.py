"""A dataset held against the truth of a simulated log."""
