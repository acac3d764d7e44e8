"""Simulation of a scene: what its sensors see."""
