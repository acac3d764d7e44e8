"""What the nightly flow calls."""
