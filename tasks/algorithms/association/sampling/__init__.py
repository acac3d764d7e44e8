"""Sampling: tracklets of all sensors at common instants, the input of the association."""
