"""Track linking: runs of one sensor that are one object, broken by frames that missed it.

`likelihood_ratio` is the default; `prediction` is the published method. Both say which
fragment continues which, each at most one, best as a whole; several chain.
"""
