"""Faults of sensors: clocks that are off, sensors that disagree with all others."""
