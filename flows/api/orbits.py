"""Orbits: what a passage tells of one, which passages are one object, and the orbit itself."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.flows.api.arguments import (
    Time,
    floats,
    nanoseconds,
    require_nanoseconds,
    time_ns,
)
from epipole.schemas.arrays import Array, Flags
from epipole.schemas.columns import ELEMENTS, POSITION
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.constants import ARCSEC, SECOND_NS
from epipole.tasks.algorithms.geometry.covariances import centroid_covariance
from epipole.tasks.algorithms.geometry.directions import (
    east_north,
    radec_from_unit,
    unit_from_radec,
)
from epipole.tasks.algorithms.orbit_linking.grouping import link_tracklets
from epipole.tasks.algorithms.orbits.orbital_elements import IN_DEGREES, elements_of
from epipole.tasks.algorithms.orbits.reference_frames import state_rotation
from epipole.tasks.algorithms.tracking.attributables import attributables
from epipole.tasks.common.orbit_forces import noon_ns, surroundings_of
from epipole.tasks.common.tracklet_arrays import (
    HAS_ATTRIBUTABLE,
    attributables_of,
    known_numbers,
)
from epipole.tasks.publish.object_orbits import (
    OBSERVED,
    Start,
    best_orbit,
    judge,
    observed_objects,
)

NS = "datetime64[ns]"
_SIGMAS = ["sigma_ra_arcsec", "sigma_dec_arcsec"]
# Of each row that is fitted.
_NUMBERS = ["ra_deg", "dec_deg", *_SIGMAS, "correlation", "bias_sigma_arcsec", *POSITION,
            "position_sigma_km"]  # fmt: skip


class Attributable(NamedTuple):
    """Direction and rates of a passage at its epoch, GCRF axes.

    Attributes
    ----------
    epoch : numpy.datetime64
        UTC.
    ra_deg, dec_deg : float
        Astrometric direction.
    ra_rate_arcsec_s, dec_rate_arcsec_s : float
        Its rates; the first times cos dec.
    cov_arcsec2 : (4, 4) float
        Covariance of right ascension (times cos dec), declination and their rates [arcsec,
        arcsec/s], on the axes east and north of this direction. Compare other directions and
        rates as vectors on these axes: near a pole, right ascension itself has an error of its
        sigma over cos dec, at most half a turn, and the axes turn with it.
    """

    epoch: np.datetime64
    ra_deg: float
    dec_deg: float
    ra_rate_arcsec_s: float
    dec_rate_arcsec_s: float
    cov_arcsec2: Array


class ObjectOrbit(NamedTuple):
    """An orbit at the middle of its arc, GCRF.

    Attributes
    ----------
    epoch : numpy.datetime64
        UTC.
    state : (6,) float
        Position [km] and velocity [km/s]; NaN where no orbit is found.
    cov : (6, 6) float
        Its covariance, with what each sensor's directions share.
    chi2, dof : float, int
        Weighted sum of squares, and its degrees of freedom.
    used : (n,) bool
        Which observations were fitted, in the order of the rows; false: of something else, or
        without a time or one of the numbers of direction, sensor position and their errors.
    forces : str
        As in the table `orbits`.
    elements : dict of str to float
        Osculating, by the names of the columns of `orbits`.
    verdict : str or None
        Why the orbit would be no row of `orbits`: "orbit_misfit", "no_orbit"; None: it would.
    """

    epoch: np.datetime64
    state: Array
    cov: Array
    chi2: float
    dof: int
    used: Flags
    forces: str
    elements: dict[str, float]
    verdict: str | None


def attributable(
    time: npt.ArrayLike,
    ra_deg: npt.ArrayLike,
    dec_deg: npt.ArrayLike,
    sigma_arcsec: npt.ArrayLike,
    *,
    at: Time | None = None,
) -> Attributable:
    """Return what a passage tells of an orbit: direction, rates and their covariance.

    Parameters
    ----------
    time : (n,) numpy.datetime64 or int
        Times of the detections, UTC, in order; integers are nanoseconds since 1970.
    ra_deg, dec_deg : (n,) float
        Astrometric directions, as in the table `observations`: without the aberration of the
        sensor's velocity around the Earth.
    sigma_arcsec : float or (n,) float
        Their 1-sigma errors per axis, independent from detection to detection.
    at : datetime, numpy.datetime64, str or int, optional
        Epoch of the result. None: the middle of the passage.

    Returns
    -------
    Attributable
        An epoch beyond the passage has errors that grow with the time. Of one time only, rates and
        covariance are NaN.

    Raises
    ------
    ValueError
        Where arrays differ in length, are empty or have NaN, times are not in order, are floats or
        are integers of before 1972, or a sigma is not above 0.

    References
    ----------
    Tommei, Milani and Rossi (2007), Orbit determination of space debris: admissible regions,
    Celestial Mechanics 97. Derivatives beyond the rate are fitted with the scatter of orbits as
    prior.

    Examples
    --------
    A passage at 100 arcsec/s, seen for ten seconds, with errors of 2 arcsec:

    >>> import numpy as np
    >>> from epipole.flows import api
    >>> t_s = np.arange(0.0, 10.0, 0.5)
    >>> time = np.datetime64("2019-04-01T04:00", "ns") + np.rint(t_s * 1e9).astype("m8[ns]")
    >>> found = api.attributable(time, 10.0 + 100.0 / 3600 * t_s, np.zeros(20), 2.0)
    >>> str(found.epoch), round(found.ra_deg, 4), round(found.ra_rate_arcsec_s, 3)
    ('2019-04-01T04:00:04.750000000', 10.1319, 100.0)
    >>> np.sqrt(np.diag(found.cov_arcsec2)).round(2).tolist()
    [0.62, 0.52, 0.16, 0.16]
    """
    times = np.atleast_1d(np.asarray(time))
    if times.dtype.kind in "fb":  # seconds, it may be: as nanoseconds the rates would be nonsense
        raise ValueError(f"time: is {times.dtype}, expected datetime64, or integers [ns]")
    if times.dtype.kind in "iu" and len(times):
        require_nanoseconds("time", int(times.min()))
    times = times if times.dtype.kind == "M" else times.astype(NS)
    at_ns, n = nanoseconds("time", times), len(times)
    if not n or np.isnat(times).any() or (np.diff(at_ns) < 0).any():
        raise ValueError("time: has no times, or NaT, or they are not in order")
    ra, dec = (
        np.radians(floats(name, values, n))
        for name, values in (("ra_deg", ra_deg), ("dec_deg", dec_deg))
    )
    sigma = ARCSEC * floats("sigma_arcsec", sigma_arcsec, n, repeat=True)
    if not np.isfinite([ra, dec]).all():
        raise ValueError("ra_deg, dec_deg: have values that are no numbers; leave them out")
    if not (np.isfinite(sigma) & (sigma > 0.0)).all():
        raise ValueError("sigma_arcsec: has values that are not above 0, or no numbers")
    epoch_ns = (int(at_ns[0]) + int(at_ns[-1])) // 2 if at is None else time_ns(at)
    u = unit_from_radec(ra, dec)
    fit = attributables(
        np.array([[0, n]]), np.zeros(1), (at_ns - epoch_ns) / SECOND_NS, u,
        centroid_covariance(u, sigma),
    )  # fmt: skip
    east, north = east_north(fit.u)[0]
    rate = np.where(np.isfinite(fit.cov[0]).all(), fit.w[0] / ARCSEC, np.nan)
    middle_ra, middle_dec = (float(np.degrees(angle[0])) for angle in radec_from_unit(fit.u))
    return Attributable(
        np.datetime64(epoch_ns, "ns"), middle_ra, middle_dec,
        float(rate @ east), float(rate @ north), fit.cov[0] / ARCSEC**2,
    )  # fmt: skip


def link(tracklets: pl.DataFrame | pl.LazyFrame, settings: Settings | None = None) -> pl.Series:
    """Return which tracklets are one object by the orbit through them.

    Parameters
    ----------
    tracklets : polars.DataFrame or polars.LazyFrame
        Rows like those of the table `tracklets`: attributables, with `start_time`, `end_time`,
        `sensor_id` and `track_id`. Rows with the same `object_id` (if there is such a column), and
        with the same track of a sensor, are one object before.
    settings : epipole.schemas.settings.Settings, optional
        Those of a run; its group `linking` counts.

    Returns
    -------
    polars.Series
        For each row the number of its object, from 0 in order of first appearance; null for a
        row without attributable or sensor position.

    Raises
    ------
    ValueError
        Where a column is missing.

    Notes
    -----
    As in a run, the density of chance meetings is that of some 50,000 objects; see
    `linking.log_odds`.

    Examples
    --------
    Tracklets of the example, as if no object were known:

    >>> from epipole.flows import api
    >>> tracklets = api.open_dataset("out/")["tracklets"].collect()
    >>> found = api.link(tracklets.drop("object_id"))
    >>> len(found), found.null_count()
    (36, 0)
    """
    linking = (settings or Settings()).linking
    tracklets = tracklets.lazy().collect()
    rows = tracklets.drop("row", strict=False).with_row_index("row")
    try:
        if "object_id" not in rows.columns:
            rows = rows.with_columns(object_id=pl.lit(None, pl.String))
        rows = rows.filter(HAS_ATTRIBUTABLE).sort("epoch", "row")
        if not len(rows):
            return pl.Series("label", [None] * len(tracklets), pl.Int64)
        found = link_tracklets(
            attributables_of(rows), known_numbers(rows).to_numpy(),
            max_gap_s=linking.max_gap_s, log_odds=linking.log_odds,
            max_orbit_gap_s=linking.max_orbit_gap_s,
        )  # fmt: skip
    except pl.exceptions.ColumnNotFoundError as error:
        raise ValueError(f"tracklets: has no column {error}") from error
    label = rows.select("row", label=pl.Series(found.label, dtype=pl.Int64))
    of_rows = tracklets.select(pl.int_range(pl.len(), dtype=pl.UInt32).alias("row"))
    found_of = of_rows.join(label, on="row", how="left", maintain_order="left")["label"]
    first = found_of.drop_nulls().unique(maintain_order=True)
    return found_of.replace_strict(first, pl.int_range(len(first), eager=True), default=None)


def fit_orbit(
    observations: pl.DataFrame | pl.LazyFrame, start: npt.ArrayLike | None = None
) -> ObjectOrbit:
    """Return the orbit of an object, fitted to observations of it.

    Parameters
    ----------
    observations : polars.DataFrame or polars.LazyFrame
        Rows like those of the table `observations`, all of one object and of one night or two, in
        any order. `tracklet_id` and `object_id` are not needed.
    start : (6,) float, optional
        Position [km] and velocity [km/s], GCRF, at the middle of the rows, to begin with. None:
        found from the directions.

    Returns
    -------
    ObjectOrbit
        NaN where none is found; `verdict` says why.

    Raises
    ------
    ValueError
        Where a column is missing, there are no rows, a sigma is 0, or `start` is not a state.

    Examples
    --------
    A minute of a geostationary object:

    >>> import polars as pl
    >>> from epipole.flows import api
    >>> seen = api.open_dataset("out/")["observations"]
    >>> orbit = api.fit_orbit(seen.filter(pl.col("object_id") == "20190401-00001").collect())
    >>> orbit.verdict, orbit.dof, 0.8 < orbit.chi2 / orbit.dof < 1.2
    (None, 446, True)
    >>> round(orbit.elements["a_km"], -3)
    42000.0
    """
    observations = observations.lazy().collect()
    needed = [name for name in OBSERVED if name not in ("object_id", "tracklet_id")]
    if missing := [name for name in needed if name not in observations.columns]:
        raise ValueError(f"observations: has no column {', '.join(missing)}")
    if not len(observations):
        raise ValueError("observations: has no rows")
    rows = observations.select(needed).with_row_index("row").sort("time", "sensor_id", "row")
    rows = rows.with_columns(object_id=pl.lit("object"), tracklet_id=pl.lit(None, pl.String))
    if isinstance(rows.schema["time"], pl.Datetime):
        rows = rows.with_columns(pl.col("time").dt.cast_time_unit("ns"))
    known = pl.all_horizontal(pl.col(_NUMBERS).cast(pl.Float64).is_finite())
    rows = rows.filter(known & pl.col("time").is_not_null())
    if not len(rows):
        raise ValueError(f"observations: no row has all of {', '.join(_NUMBERS)}, time")
    for name in _SIGMAS:
        if wrong := int((rows[name] <= 0).sum()):
            raise ValueError(f"observations: {name} is not above 0 in {wrong} of {len(rows)} rows")
    times = rows["time"].cast(pl.Int64).to_numpy()
    middle_ns = (int(times[0]) + int(times[-1])) // 2
    night = str(np.datetime64(middle_ns, "ns").astype("datetime64[D]"))
    around, origin_ns = surroundings_of(night), noon_ns(night)
    begin = None if start is None else Start(middle_ns, _state("start", start))
    directions = observed_objects(rows, origin_ns, around).directions(0)
    fitted = best_orbit(directions, begin, origin_ns, around)
    epoch, verdict = np.datetime64(middle_ns, "ns"), judge(fitted)
    reason = None if verdict is None else verdict.value
    if fitted is None:
        nothing, unused = np.full((7, 6), np.nan), np.zeros(len(observations), bool)
        none = dict.fromkeys(ELEMENTS, np.nan)
        return ObjectOrbit(epoch, nothing[0], nothing[1:], np.nan, 0, unused, "", none, reason)
    used = np.zeros(len(observations), bool)
    used[rows["row"].to_numpy()] = fitted.orbit.used
    turn = state_rotation(around.R_night_from_gcrf.T)
    state = turn @ fitted.orbit.unknowns[:6]
    values = elements_of(state) * IN_DEGREES
    return ObjectOrbit(
        epoch, state, turn @ fitted.orbit.cov[:6, :6] @ turn.T, float(fitted.orbit.chi2),
        fitted.dof, used, fitted.forces, dict(zip(ELEMENTS, values.tolist(), strict=True)), reason,
    )  # fmt: skip


def _state(name: str, values: npt.ArrayLike) -> Array:
    """Return a state (6,) [km, km/s], as an orbit can begin with it."""
    state = floats(name, values, 6)
    if not np.isfinite(state).all() or not np.linalg.norm(state[:3]):
        raise ValueError(f"{name}: {state.tolist()} is not a position [km] and a velocity [km/s]")
    return state
