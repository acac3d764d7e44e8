"""Association: which spots in different sensors are one object."""
