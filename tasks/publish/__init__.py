"""Stage `publish`: the tables of each night, published at once."""
