"""Which tracklets of different sensors are one object."""
