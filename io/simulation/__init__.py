"""The simulator's files: scenes, skies and the truth of a log."""
