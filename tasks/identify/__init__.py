"""Stage `identify`: stars, attitudes, and detections."""
