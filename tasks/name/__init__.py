"""Stage `name`: one id for each object of the night."""
