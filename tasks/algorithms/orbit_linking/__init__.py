"""Orbit linking: tracklets of different times and sensors that one orbit explains."""
