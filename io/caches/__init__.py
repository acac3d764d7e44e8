"""Caches on the disk: arrays and compiled kernels."""
