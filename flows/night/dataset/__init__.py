"""The nights of a dataset: what each was made from, which are stale, what later ones need."""
