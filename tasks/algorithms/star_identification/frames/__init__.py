"""Frames: the centroids of one frame, and of all frames of a sensor."""
