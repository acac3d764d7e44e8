"""Satellites that move by published element sets: SGP4, and its frame TEME in GCRF."""
