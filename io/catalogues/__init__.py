"""Catalogues: stars, and the orientation of the Earth."""
