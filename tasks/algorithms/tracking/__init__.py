"""Tracking: detections of one sensor that are one object."""
