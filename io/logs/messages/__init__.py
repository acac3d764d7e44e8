"""The messages in a log: bytes to values and back, in each encoding."""
