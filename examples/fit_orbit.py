"""Fit an orbit to the angles of one object, from the table `observations` alone.

    python examples/fit_orbit.py out/ [OBJECT_ID]

The first guess is a row of `states`. What all frames of a sensor share (`bias_sigma_arcsec`,
`position_sigma_km`) is fitted too, with these sigmas as what is known of it before.
"""

import sys

import numpy as np
import polars as pl
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

GM, J2, EARTH_KM, LIGHT_KM_S = 398600.4418, 1.08262668e-3, 6378.1363, 299792.458
ARCSEC = np.pi / 648000


def motion(_t, state):
    """Return velocity and acceleration: the Earth's mass and its flattening."""
    r, z2 = state[:3], (state[2] / np.linalg.norm(state[:3])) ** 2
    d = np.linalg.norm(r)
    oblate = 1.5 * J2 * (EARTH_KM / d) ** 2 * (np.array([5, 5, 5]) * z2 - np.array([1, 1, 3]))
    return np.concatenate([state[3:], GM / d**3 * r * (oblate - 1)])


def places(state, t_s):
    """Return where an object with this state at 0 s is at these times, (n, 3) [km]."""
    parts = [(t_s < 0, min(t_s.min(), -1.0)), (t_s >= 0, max(t_s.max(), 1.0))]
    r = np.empty((len(t_s), 3))
    for some, end in parts:
        way = solve_ivp(motion, (0, end), state, "DOP853", rtol=1e-11, atol=1e-9, dense_output=True)
        r[some] = way.sol(t_s[some])[:3].T
    return r


def fit(rows, epoch, guess):
    """Return the state at the epoch, its covariance, chi2 and its degrees of freedom."""
    t_s = (rows["time"] - epoch).dt.total_nanoseconds().to_numpy() / 1e9
    ra, dec = (np.radians(rows[name].to_numpy()) for name in ("ra_deg", "dec_deg"))
    u = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    east = np.stack([-np.sin(ra), np.cos(ra), 0 * ra], axis=1)
    north = np.cross(u, east)
    sensor_km = rows.select("x_km", "y_km", "z_km").to_numpy()
    s_ra, s_dec, bias = (
        rows[f"{name}_arcsec"].to_numpy() * ARCSEC
        for name in ("sigma_ra", "sigma_dec", "bias_sigma")
    )
    correlation, place_km = rows["correlation"].to_numpy(), rows["position_sigma_km"].to_numpy()
    sensor = rows["sensor_id"].rank("dense").to_numpy().astype(int) - 1
    scale = np.array([100.0] * 3 + [0.1] * 3)  # so that the steps of the derivatives are not noise

    def residuals(x):
        shared = x[6:].reshape(-1, 5)[sensor]  # of each sensor, in its sigmas
        from_km = sensor_km + shared[:, 2:] * place_km[:, None]
        distance = np.linalg.norm(guess[:3] - from_km, axis=1)
        for _ in range(2):  # the light left earlier
            line = places(guess + x[:6] * scale, t_s - distance / LIGHT_KM_S) - from_km
            distance = np.linalg.norm(line, axis=1)
        off = np.stack([np.sum(a * line, axis=1) / distance for a in (east, north)], axis=1)
        off = off + shared[:, :2] * bias[:, None]
        first = off[:, 0] / s_ra
        second = (off[:, 1] / s_dec - correlation * first) / np.sqrt(1 - correlation**2)
        return np.concatenate([first, second, x[6:]])

    start = np.zeros(6 + 5 * (sensor.max() + 1))
    found = least_squares(residuals, start, jac="3-point", x_scale="jac")
    cov = np.linalg.inv(found.jac.T @ found.jac)[:6, :6] * np.outer(scale, scale)
    return guess + found.x[:6] * scale, cov, 2 * found.cost, 2 * len(rows) - 6


def main(dataset, object_id=None):
    """Print the orbit of one object."""
    tables = {
        name: pl.read_parquet(f"{dataset}/night=*/{name}/*.parquet")
        for name in ("states", "observations")
    }
    start = tables["states"].filter(pl.col("object_id") == (object_id or pl.col("object_id").min()))
    (row,) = start.sort("epoch").head(1).iter_rows(named=True)
    axes = [*(f"{a}_km" for a in "xyz"), *(f"v{a}_km_s" for a in "xyz")]
    rows = tables["observations"].filter(pl.col("object_id") == row["object_id"])
    guess = np.array([row[name] for name in axes])
    state, cov, chi2, freedom = fit(rows, row["epoch"], guess)
    print(f"{row['object_id']}: {len(rows)} observations by {rows['sensor_id'].n_unique()} sensors")
    for name, value, sigma in zip(axes, state, np.sqrt(np.diag(cov)), strict=True):
        print(f"  {name:8} {value:12.4f} +- {sigma:.4f}")
    print(f"  chi2 {chi2:.0f} of {freedom} degrees of freedom")


if __name__ == "__main__":
    main(*sys.argv[1:])
