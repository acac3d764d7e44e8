"""Star identification: which centroid is which star, and the attitude that follows."""
