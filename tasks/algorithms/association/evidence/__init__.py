"""Evidence: how much more likely one object is than unrelated tracklets."""
