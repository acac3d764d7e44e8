"""Stage `check`: whether the sensors' clocks are right, and frames at their true times."""
