"""Catalogues: stars to navigate by, and element sets of known objects."""
