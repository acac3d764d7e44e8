"""The simulator: scenes, and the report of an evaluation."""
