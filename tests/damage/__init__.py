"""Damaged input: logs that are altered by number, odd values, bombs, and who judges the reader."""
