"""Star catalogues built from published catalogues."""
