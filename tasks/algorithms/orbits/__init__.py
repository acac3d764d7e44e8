"""Orbits: Earth-centred frames, states of sensors, orbits of objects and of planets."""
