"""The views of objects: the directions of each sensor's tracklets at the epochs."""
