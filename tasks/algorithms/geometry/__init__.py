"""Geometry: rotations, directions, cameras, attitudes, lines of sight."""
