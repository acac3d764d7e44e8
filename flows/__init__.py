"""What runs, in which order, on how many workers; and the command line."""
