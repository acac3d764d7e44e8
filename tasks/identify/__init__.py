"""Stage `identify`: stars, attitudes, and what is no star."""
