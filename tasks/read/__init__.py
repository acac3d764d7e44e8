"""Stage `read`: logs to frames, states and calibrations in order of time."""
