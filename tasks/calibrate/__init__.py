"""Stage `calibrate`: each sensor's optics from its stars."""
