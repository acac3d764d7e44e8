"""Stage `publish`: the tables of each night, put in place at once."""
