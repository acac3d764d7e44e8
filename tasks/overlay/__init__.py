"""A night as messages that viewers of MCAP files draw: annotations of images, and a 3D scene."""
