"""The commands of `epipole`, one file each; the docstring of a command is its help."""
