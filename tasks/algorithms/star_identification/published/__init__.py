"""The published methods, each by itself."""
