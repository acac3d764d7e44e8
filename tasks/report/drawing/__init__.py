"""The pictures of the report: what was computed, drawn with matplotlib."""
