"""Star catalogues built from the catalogues of others."""
