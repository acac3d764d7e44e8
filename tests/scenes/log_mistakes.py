"""Mistakes in how a log is written: the right data, one thing written otherwise.

`MISTAKES` has a function for each, from the content of a log and the sensors that have the mistake
to the content with it. `rewritten` writes such content as a log.
"""

import erfa
import numpy as np
import polars as pl

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import from_polars, to_polars
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, LOG_STATES
from epipole.tasks.algorithms.orbits.reference_frames import orientation_at, tt_julian_date
from scenes.altered_logs import frame_values, state_values, table_rows

R = ["x_km", "y_km", "z_km"]
V = ["vx_km_s", "vy_km_s", "vz_km_s"]
EARTH_RATE_RAD_S = 7.2921150e-5


def of(names):
    return pl.col("sensor_id").is_in(list(names))


def states(log, names, **columns):
    """Return the log with other values in the states of some sensors."""
    changed = [pl.when(of(names)).then(value).otherwise(pl.col(name)).alias(name)
               for name, value in columns.items()]  # fmt: skip
    rows = to_polars(log.states).with_columns(changed)
    return log._replace(states=from_polars(LOG_STATES, rows))


def frames(log, names, **columns):
    changed = [pl.when(of(names)).then(value).otherwise(pl.col(name)).alias(name)
               for name, value in columns.items()]  # fmt: skip
    rows = to_polars(log.exposures).with_columns(changed)
    return log._replace(exposures=from_polars(EXPOSURES, rows))


def cameras(log, names, **columns):
    changed = [pl.when(of(names)).then(value).otherwise(pl.col(name)).alias(name)
               for name, value in columns.items()]  # fmt: skip
    rows = to_polars(log.cameras).with_columns(changed)
    return log._replace(cameras=from_polars(CAMERAS, rows))


def times(factor):
    """Return a mistake: states times a factor; `(position, velocity)`."""
    return lambda log, names: states(
        log, names,
        **{c: pl.col(c) * factor[0] for c in R}, **{c: pl.col(c) * factor[1] for c in V},
    )  # fmt: skip


def axes(r, v=None):
    """Return a mistake: other axes, such as "yxz" or "-xyz"; of velocities too unless given."""

    def column(text, pattern):
        signs = [-1 if t.startswith("-") else 1 for t in text.split()]
        return [s * pl.col(pattern.format(t[-1])) for s, t in zip(signs, text.split(), strict=True)]

    def changed(log, names):
        new = dict(zip(R, column(r, "{}_km"), strict=True))
        new |= dict(zip(V, column(v or r, "v{}_km_s"), strict=True))
        return states(log, names, **new)

    return changed


def later(seconds, *kinds):
    """Return a mistake: times of frames, states or both are later."""

    def changed(log, names):
        shifted = pl.col("time") + pl.duration(microseconds=round(seconds * 1e6))
        for kind in kinds:
            log = {"frames": frames, "states": states}[kind](log, names, time=shifted)
        return log

    return changed


def cut(every):
    return lambda log, names: frames(log, names, time=pl.col("time").dt.truncate(every))


def starts_of_exposures(exposure_s):
    """Return a mistake: times are those of the start of exposures of this length."""
    half = pl.duration(microseconds=round(exposure_s / 2 * 1e6))
    return lambda log, names: frames(
        log, names, time=pl.col("time") - half, exposure_s=pl.lit(exposure_s)
    )


def turned(back, label):
    """Return a mistake: positions turned to Earth-fixed axes, or (`back`) from them, labelled so.

    Velocities turn too, with the rotation of the Earth in them.
    """

    def changed(log, names):
        rows = to_polars(log.states)
        chosen = rows["sensor_id"].is_in(list(names)).to_numpy()
        time_ns = rows["time"].cast(pl.Int64).to_numpy()
        r, v = rows.select(R).to_numpy().copy(), rows.select(V).to_numpy().copy()
        at = orientation_at(time_ns, *read_earth_orientation())
        turn = erfa.c2t06a(*tt_julian_date(time_ns), *at.ut1, at.xp_rad, at.yp_rad)
        turn = np.swapaxes(turn, 1, 2) if back else turn
        w = np.array([0, 0, EARTH_RATE_RAD_S])
        if back:
            v += np.cross(w, r)
        new_r, new_v = np.einsum("nij,nj->ni", turn, r), np.einsum("nij,nj->ni", turn, v)
        if not back:
            new_v -= np.cross(w, new_r)
        r[chosen], v[chosen] = new_r[chosen], new_v[chosen]
        columns = {**dict(zip(R, r.T, strict=True)), **dict(zip(V, v.T, strict=True))}
        rows = rows.with_columns(**{name: pl.Series(value) for name, value in columns.items()})
        log = log._replace(states=from_polars(LOG_STATES, rows))
        return states(log, names, frame=pl.lit(label))

    return changed


def inertial_velocities(log, names):
    """ITRF with velocities that do not subtract the Earth's rotation."""
    log = turned(False, "ITRF")(log, names)
    return states(
        log, names, vx_km_s=pl.col("vx_km_s") - EARTH_RATE_RAD_S * pl.col("y_km"),
        vy_km_s=pl.col("vy_km_s") + EARTH_RATE_RAD_S * pl.col("x_km"),
    )  # fmt: skip


def one_id(log, names):
    """All these sensors, and one more, have the id of the first."""
    ids = sorted(set(log.states["sensor_id"].to_pylist()))
    first = sorted(names)[0]
    pair = {first, ids[(ids.index(first) + 1) % len(ids)]}
    name = pl.when(of(pair)).then(pl.lit(first)).otherwise("sensor_id").alias("sensor_id")
    return log._replace(
        states=from_polars(LOG_STATES, to_polars(log.states).with_columns(name)),
        exposures=from_polars(EXPOSURES, to_polars(log.exposures).with_columns(name)),
        cameras=from_polars(CAMERAS, to_polars(log.cameras).with_columns(name)),
    )


def exchanged(log, names):
    """Return the log with the ephemerides of a sensor, or of the first, and the next exchanged."""
    ids = sorted(set(log.states["sensor_id"].to_pylist()))
    first = sorted(names)[0]
    other = ids[(ids.index(first) + len(ids) // 2) % len(ids)]
    name = pl.col("sensor_id").replace({first: other, other: first})
    rows = to_polars(log.states).with_columns(sensor_id=name)
    return log._replace(states=from_polars(LOG_STATES, rows))


def scattered(km):
    """Return a mistake: an error of this size in each state, which the sigma does not have."""

    def changed(log, names):
        rng = np.random.default_rng(1)
        n = log.states.num_rows
        noise = {name: pl.col(name) + pl.Series(rng.normal(0, km, n)) for name in R}
        return states(log, names, **noise, position_sigma_km=pl.lit(0.001))

    return changed


def magnitudes(log, names):
    bright = pl.col("flux").list.eval(12.0 - 2.5 * (pl.element() + 1e-30).log10())
    return frames(log, names, flux=bright.cast(pl.List(pl.Float32)))


def centroid_sigma(px):
    """Return a mistake: all centroids have this error."""
    sigma = pl.col("sigma_px").list.eval(pl.element() * 0 + px).cast(pl.List(pl.Float32))
    return lambda log, names: frames(log, names, sigma_px=sigma)


def without_camera(log, names):
    rows = to_polars(log.cameras).filter(~of(names))
    return log._replace(cameras=from_polars(CAMERAS, rows))


NOTHING = times((1.0, 1.0))
EARTH_FIXED = turned(False, "ITRF")  # no mistake

# By name, with the cause that states and frames alone show; None: they show none.
MISTAKES = {
    "positions in m": (times((1e3, 1.0)), "positions_in_m"),
    "positions and sigmas in m": (
        lambda log, names: states(
            times((1e3, 1.0))(log, names), names, position_sigma_km=pl.lit(22.4)
        ),
        "positions_in_m",
    ),
    "velocities in m/s": (times((1.0, 1e3)), "velocities_in_m_s"),
    "velocities zero": (times((1.0, 0.0)), "velocities_zero"),
    "velocities negated": (times((1.0, -1.0)), "velocities_negated"),
    "velocities in other axes": (axes("x y z", "y x z"), "velocity_axes"),
    "ITRF as GCRF": (turned(False, "GCRF"), "earth_fixed_states"),
    "GCRF as ITRF": (lambda log, n: states(log, n, frame=pl.lit("ITRF")), "inertial_states"),
    "ITRF with inertial velocities": (inertial_velocities, "velocities_inertial"),
    "sigma of a metre": (scattered(1.0), "sigma_too_small"),
    "frames as GPS time": (later(18, "frames"), "frames_and_states_shifted"),
    "states as GPS time": (later(18, "states"), "frames_and_states_shifted"),
    "frames as TAI": (later(37, "frames"), "frames_and_states_shifted"),
    "frames an hour late": (later(3600, "frames"), "frames_and_states_shifted"),
    "states an hour early": (later(-3600, "states"), "frames_and_states_shifted"),
    "principal point 0, 0": (
        lambda log, n: cameras(log, n, cx_px=pl.lit(0.0), cy_px=pl.lit(0.0)),
        "principal_point_zero",
    ),
    "image half as large": (
        lambda log, n: cameras(log, n, width=pl.col("width") // 2, height=pl.col("height") // 2),
        "image_too_small",
    ),
    "magnitudes as flux": (magnitudes, "flux_is_magnitude"),
    "errors of centroids in radians": (centroid_sigma(1e-4), "impossible_centroid_sigma"),
    "exposures in ms": (
        lambda log, n: frames(log, n, exposure_s=pl.lit(200.0)), "exposure_too_long",
    ),
    "no calibration": (without_camera, "no_calibration"),
    "two sensors with one id": (one_id, "two_sensors"),
    # What states and frames alone do not show.
    "GCRF as TEME": (lambda log, n: states(log, n, frame=pl.lit("TEME")), None),
    "x and y exchanged": (axes("y x z"), None),
    "z negated": (axes("x y -z"), None),
    "all times as GPS time": (later(18, "frames", "states"), None),
    "all times an hour late": (later(3600, "frames", "states"), None),
    "starts of exposures": (starts_of_exposures(1.0), None),
    "times cut to seconds": (cut("1s"), None),
    "ephemerides exchanged": (exchanged, None),
    "an ephemeris 1 km off": (
        lambda log, n: states(log, n, x_km=pl.col("x_km") + 1.0, position_sigma_km=pl.lit(0.001)),
        "sigma_too_small",  # a metre is less than the scatter
    ),
}  # fmt: skip


def rewritten(log, path):
    """Write the content of a log as a log, and return its path."""
    with LogWriter(path) as out:
        for row in table_rows(log.cameras):
            out.camera(row["sensor_id"], row["time_ns"], row)
        for kind, rows in (
            ("state", map(state_values, table_rows(log.states))),
            ("frame", map(frame_values, table_rows(log.exposures))),
        ):
            for row in rows:
                getattr(out, kind)(row.pop("sensor_id"), row.pop("time_ns"), **row)
    return path
