"""Two sensors and a geostationary object."""

import numpy as np

R_1 = np.array([5000.0, 4000.0, 3000.0])
R_2 = np.array([-2000.0, 6500.0, 1000.0])
GEO = np.array([-39359.89, 15125.76, 64.30])


def look(r, x):
    """Return the unit vectors from r to x."""
    return (x - r) / np.linalg.norm(x - r, axis=-1, keepdims=True)


def attitude(boresight, seed):
    """Return an attitude (sensor from ICRS) with this boresight and a random roll."""
    x = np.cross(np.random.default_rng(seed).normal(size=3), boresight)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(boresight, x), boresight])
