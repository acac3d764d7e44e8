"""The messages of a log as columns: frames, states and calibrations."""
