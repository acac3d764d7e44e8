"""Stage `solve`: epochs, associations, positions and states."""
