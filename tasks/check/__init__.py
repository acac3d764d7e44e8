"""Stage `check`: whether the sensors are sound, and frames at their true times."""
