"""The search: hypotheses of an attitude, and the verdict on each."""
