"""Orbits from passages: attributables, links and fits, as a notebook asks for them."""

import numpy as np
import polars as pl
import pytest
from scenes.night_orbits import AROUND, GEO, LOW, NOON_NS, trial
from scenes.orbit_tracklets import orbit_tracklets, rows_of

from epipole.flows import api
from epipole.schemas.settings import LinkingSettings, Settings

TIME = np.datetime64("2026-05-30T12:00", "ns") + np.arange(20) * np.timedelta64(500, "ms")
R = AROUND.R_night_from_gcrf
NEVER = Settings(linking=LinkingSettings(log_odds=1000.0))


def passage(**other):
    t_s = np.arange(20) * 0.5
    given = {"time": TIME, "ra_deg": 40.0 + 0.1 * t_s, "dec_deg": 60.0 - 0.05 * t_s,
             "sigma_arcsec": 3.0}  # fmt: skip
    return api.attributable(**given | other)


def test_direction_and_rates_are_of_the_middle():
    found = passage()
    assert found.epoch == np.datetime64("2026-05-30T12:00:04.75", "ns")
    assert found.dec_deg == pytest.approx(60.0 - 0.05 * 4.75, abs=1e-3)
    assert found.dec_rate_arcsec_s == pytest.approx(-180.0, abs=1.0)
    cosine = np.cos(np.radians(found.dec_deg))
    assert found.ra_rate_arcsec_s == pytest.approx(360.0 * cosine, abs=1.0)
    # The mean of 20 detections, and their slope.
    sigma = np.sqrt(np.diag(found.cov_arcsec2))
    assert sigma[0] > 3.0 / np.sqrt(20)
    assert sigma[2] > 3.0 / (0.5 * np.sqrt(20 * (20**2 - 1) / 12))


def test_the_epoch_can_be_chosen_and_errors_given_one_by_one():
    found = passage(at=TIME[3], sigma_arcsec=np.full(20, 3.0))
    assert found.epoch == TIME[3]
    assert found.dec_deg == pytest.approx(60.0 - 0.05 * 1.5, abs=1e-3)
    late = passage(at=TIME[0] + np.timedelta64(1, "m"))
    assert late.cov_arcsec2[0, 0] > 1e4 * found.cov_arcsec2[0, 0]


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"time": TIME[::-1]}, "not in order"),
        ({"time": TIME[:0]}, "no times"),
        ({"time": np.append(TIME[:-1], np.datetime64("NaT"))}, "or NaT"),
        ({"time": np.arange(20.0)}, "time: is float64, expected datetime64, or integers"),
        ({"time": np.arange(20) + 1_554_091_200}, "time: 1554091200 ns is before 1972, expected"),
        ({"ra_deg": [1.0]}, r"ra_deg: has shape \(1,\), expected \(20,\)"),
        ({"dec_deg": np.append(np.ones(19), np.nan)}, "no numbers; leave them out"),
        ({"sigma_arcsec": 0.0}, "not above 0"),
        ({"sigma_arcsec": -3.0}, "not above 0"),
        ({"sigma_arcsec": np.append(np.ones(19), np.nan)}, "not above 0, or no numbers"),
    ],
)
def test_a_passage_that_cannot_be_used_is_an_error(other, says):
    with pytest.raises(ValueError, match=says):
        passage(**other)


@pytest.mark.parametrize("n", [1, 4])
def test_detections_of_one_time_have_no_rates(n):
    found = api.attributable([TIME[0]] * n, [10.0] * n, [20.0] * n, 2.0)
    assert (found.ra_deg, found.dec_deg) == pytest.approx((10.0, 20.0), abs=1e-3)
    assert np.isnan([found.ra_rate_arcsec_s, found.dec_rate_arcsec_s]).all()
    assert np.isnan(found.cov_arcsec2).all()


def observations(truth, **other):
    """Observations of an object around noon, by three sensors, in no order."""
    seen = trial(1, truth, noise=2.0, bias=3.0, **other)
    u, n = seen.u @ R, len(seen.u)
    rows = pl.DataFrame({
        "time": NOON_NS + np.round(seen.time_s * 1e9).astype(np.int64),
        "sensor_id": [f"s{k}" for k in seen.sensor],
        "ra_deg": np.degrees(np.arctan2(u[:, 1], u[:, 0])),
        "dec_deg": np.degrees(np.arcsin(u[:, 2])),
        "sigma_ra_arcsec": [2.0] * n, "sigma_dec_arcsec": [2.0] * n, "correlation": [0.0] * n,
        "bias_sigma_arcsec": [3.0] * n, "position_sigma_km": [0.02] * n,
        **dict(zip(("x_km", "y_km", "z_km"), (seen.r_km @ R).T, strict=True)),
    })  # fmt: skip
    return rows.with_columns(pl.col("time").cast(pl.Datetime("ns", "UTC"))).reverse()


@pytest.mark.parametrize(("truth", "times_s"), [(GEO, None), (LOW, np.linspace(-60, 60, 21))])
def test_an_orbit_is_fitted_with_and_without_an_initial_state(truth, times_s):
    rows = observations(truth, times_s=times_s)
    true = np.concatenate([R.T @ truth[:3], R.T @ truth[3:6]])
    for start in (None, true + 0.01):
        orbit = api.fit_orbit(rows, start)
        off = orbit.state - true
        assert off @ np.linalg.solve(orbit.cov, off) < 22.5  # 1 in 1,000 is above
        assert orbit.verdict is None
        assert orbit.used.all()
        assert orbit.epoch == np.datetime64(NOON_NS, "ns")
        radius = np.linalg.norm(true[:3])
        speed2 = true[3:] @ true[3:]
        a_km = 1 / (2 / radius - speed2 / 398600.4418)
        assert orbit.elements["a_km"] == pytest.approx(a_km, rel=0.05)


def test_what_is_not_fitted_is_said_row_by_row():
    rows = observations(GEO).with_row_index("n")
    off = rows.with_columns(dec_deg=pl.col("dec_deg") + 0.02 * (pl.col("n") == 5))
    assert np.flatnonzero(~api.fit_orbit(off).used).tolist() == [5]


@pytest.mark.parametrize("unit", ["us", "ms"])
def test_the_unit_of_times_changes_nothing(unit):
    rows = observations(GEO).with_columns(pl.col("time").dt.round("1ms"))
    expected = api.fit_orbit(rows)
    found = api.fit_orbit(rows.with_columns(pl.col("time").dt.cast_time_unit(unit)))
    assert found.epoch == expected.epoch
    np.testing.assert_array_equal(found.state, expected.state)


def test_a_row_without_a_direction_is_not_fitted():
    rows = observations(GEO).with_row_index("n")
    gone = rows.with_columns(ra_deg=pl.when(pl.col("n") != 5).then("ra_deg").otherwise(np.nan))
    orbit = api.fit_orbit(gone)
    assert orbit.verdict is None
    assert np.flatnonzero(~orbit.used).tolist() == [5]
    with pytest.raises(ValueError, match="no row has all of ra_deg"):
        api.fit_orbit(rows.with_columns(ra_deg=pl.lit(None, pl.Float64)))


@pytest.mark.parametrize("column", ["x_km", "position_sigma_km", "bias_sigma_arcsec", "time"])
def test_a_row_without_a_sensor_position_its_error_or_a_time_is_not_fitted(column):
    rows = observations(GEO).with_row_index("n")
    gone = rows.with_columns(pl.when(pl.col("n") != 5).then(column).alias(column))
    orbit = api.fit_orbit(gone)
    assert orbit.verdict is None
    assert np.flatnonzero(~orbit.used).tolist() == [5]


def test_numbers_that_no_fit_can_take_are_named():
    rows = observations(GEO)
    with pytest.raises(ValueError, match=f"sigma_dec_arcsec is not above 0 in {len(rows)} of"):
        api.fit_orbit(rows.with_columns(sigma_dec_arcsec=pl.lit(0.0)))
    for start in (np.zeros(6), [np.nan] * 6):
        with pytest.raises(ValueError, match=r"start: .* is not a position \[km\] and a velocity"):
            api.fit_orbit(rows, start)


def test_tables_may_be_lazy_as_those_of_a_dataset_are():
    rows = observations(GEO)
    assert api.fit_orbit(rows.lazy()).chi2 == api.fit_orbit(rows).chi2
    tracklets = pl.DataFrame(rows_of(orbit_tracklets(11, 6, 4, 60.0)))
    assert api.link(tracklets.lazy()).to_list() == api.link(tracklets).to_list()


def test_too_few_rows_give_no_orbit():
    orbit = api.fit_orbit(observations(GEO).head(3))
    assert orbit.verdict == "no_orbit"
    assert np.isnan(orbit.state).all()
    assert not orbit.used.any()


def test_missing_columns_and_rows_are_named():
    rows = observations(GEO)
    with pytest.raises(ValueError, match="has no column correlation, x_km"):
        api.fit_orbit(rows.drop("correlation", "x_km"))
    with pytest.raises(ValueError, match="has no rows"):
        api.fit_orbit(rows.clear())


def test_links_are_numbered_in_the_order_of_their_first_rows():
    scene = orbit_tracklets(11, 6, 4, 60.0)
    rows = pl.DataFrame(rows_of(scene))
    first = list(dict.fromkeys(scene.object.tolist()))
    expected = [first.index(k) for k in scene.object.tolist()]
    assert api.link(rows).to_list() == expected
    assert api.link(rows.drop("object_id")).to_list() == expected
    # A row without an attributable has no object, and the others stay as they are.
    bare = rows.with_columns(cov_rara=pl.when(pl.int_range(24) != 23).then("cov_rara"))
    assert api.link(bare).to_list() == [*expected[:23], None]


def test_links_are_numbered_by_the_rows_whatever_their_order():
    scene = orbit_tracklets(11, 6, 4, 60.0)
    rows = pl.DataFrame(rows_of(scene)).with_columns(of=pl.Series(scene.object), row=pl.lit(0))
    for seed in range(3):
        mixed = rows.sample(fraction=1.0, shuffle=True, seed=seed)
        first = list(dict.fromkeys(mixed["of"].to_list()))
        assert api.link(mixed).to_list() == [first.index(k) for k in mixed["of"].to_list()]


def test_known_objects_are_kept_and_links_can_be_refused():
    scene = orbit_tracklets(11, 6, 4, 60.0)
    rows = pl.DataFrame(rows_of(scene))
    alone = api.link(rows, NEVER)
    assert alone.to_list() == list(range(24))
    known = rows.with_columns(object_id=pl.Series([f"o{k}" for k in scene.object]))
    assert api.link(known, NEVER).equals(api.link(known))


@pytest.mark.filterwarnings("error")
def test_tracklets_of_no_track_are_each_by_itself_before():
    scene = orbit_tracklets(11, 6, 4, 60.0)
    rows = pl.DataFrame(rows_of(scene)).with_columns(
        track_id=pl.when(pl.int_range(24) % 2 == 0).then("track_id")
    )
    assert api.link(rows, NEVER).to_list() == list(range(24))


def test_a_table_that_is_not_of_tracklets_is_an_error():
    with pytest.raises(ValueError, match="tracklets: has no column"):
        api.link(pl.DataFrame({"tracklet_id": ["t"]}))


def test_no_tracklets_have_no_objects():
    assert api.link(pl.DataFrame(rows_of(orbit_tracklets(11, 6, 4, 60.0))).clear()).to_list() == []


@pytest.mark.parametrize("dec_deg", [0.0, 89.999, 90.0])
def test_the_covariance_of_an_attributable_holds_on_its_axes_at_a_pole_too(dec_deg):
    rng, t_s, dec = np.random.default_rng(0), np.arange(20) * 0.5 - 4.75, np.radians(dec_deg)
    time = np.datetime64("2019-04-01T04:00", "ns") + np.rint(t_s * 1e9).astype("m8[ns]")
    there = np.array([np.cos(dec), 0.0, np.sin(dec)])
    axes = np.array([[0.0, 1.0, 0.0], [-np.sin(dec), 0.0, np.cos(dec)]])
    squares = []
    for _ in range(60):
        u = there + (50 * t_s[:, None] * axes[0] + rng.normal(0, 2.0, (20, 2)) @ axes) / 206265
        ra, up = np.arctan2(u[:, 1], u[:, 0]), np.arctan2(u[:, 2], np.hypot(u[:, 0], u[:, 1]))
        found = api.attributable(time, np.degrees(ra), np.degrees(up), 2.0)
        a, d = np.radians([found.ra_deg, found.dec_deg])
        east = np.array([-np.sin(a), np.cos(a), 0.0])
        north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
        off = there - np.cross(east, north)
        rate = 50 * axes[0] - found.ra_rate_arcsec_s * east - found.dec_rate_arcsec_s * north
        z = [206265 * off @ east, 206265 * off @ north, rate @ east, rate @ north]
        squares.append(z @ np.linalg.solve(found.cov_arcsec2, z))
    assert np.mean(squares) == pytest.approx(4.0, rel=0.25)
