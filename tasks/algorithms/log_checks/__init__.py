"""Checks of logs: units, reference frames, times and cameras as they were written.

A check takes arrays of one sensor and returns a `Finding`. It calls a log wrong only where another
reading of the same numbers (metres for kilometres, another frame) fits and the stated one does not.
"""
