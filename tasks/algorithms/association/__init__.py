"""Association: which tracklets of different sensors are one object."""
