"""Star catalogues, and the table of the Earth's orientation."""
