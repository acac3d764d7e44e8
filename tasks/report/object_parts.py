"""The parts of the page about one object each: light curve, residuals by sensor, orbit."""

from itertools import pairwise

import polars as pl

from epipole.tasks.report.dot_plot import Dots, draw_dots
from epipole.tasks.report.frame_series import clock, seconds_of_day
from epipole.tasks.report.html import (
    beside,
    details,
    figure,
    figures,
    nothing,
    paragraph,
    table,
    with_sigma,
)
from epipole.tasks.report.night_facts import NightFacts, duration
from epipole.tasks.report.object_details import ELEMENTS, ObjectDetail
from epipole.tasks.report.objects import NightObject

USUAL = 2.0**0.5  # rms of residual_sigma where the sigmas hold


def detailed(facts: NightFacts) -> str:
    """Return a part for each of the objects that are shown more closely."""
    by_id = {each.object_id: each for each in facts.objects}
    parts = [
        details(f"object-{k}", by_id[each.object_id].about, _part(each, by_id[each.object_id]))
        for k, each in enumerate(facts.details, start=1)
    ]
    if not parts:
        return ""
    some = ""
    if len(parts) < len(by_id):
        some = f" {len(parts)} of {len(by_id):,} are shown, those that are not sound first."
    about = paragraph(f"Light curve, residuals by sensor and orbit of each object.{some}")
    return "<h3>Each object</h3>\n" + about + "".join(parts)


def _part(detail: ObjectDetail, found: NightObject) -> str:
    pictures = [*_light_curve(detail, found), *_residuals(detail, found)]
    return beside(figures(pictures) or nothing("No observation of it is kept."),
                  _by_sensor(detail) + _orbit(detail))  # fmt: skip


def _light_curve(detail: ObjectDetail, found: NightObject) -> list[str]:
    column = "magnitude_1000_km"
    if not detail.seen[column].count():
        column = "magnitude"
    svg = draw_dots(_dots(detail, column, "magnitude_sigma"), "magnitude", down=True)
    what = "at 1,000 km" if column == "magnitude_1000_km" else "as seen: no distance is known"
    says = f"Light curve: V magnitude {what}, with bars of one sigma.{_every(detail)}"
    return [figure(svg, f"Light curve of {found.object_id}.", says)] if svg else []


def _residuals(detail: ObjectDetail, found: NightObject) -> list[str]:
    svg = draw_dots(_dots(detail, "residual_sigma", ""), "residual / sigma", level=USUAL)
    says = (
        "Residuals: distance from the orbit in sigmas, of two axes together, so the rms should be "
        f"the dashed line. A run of large ones is a second object or a manoeuvre.{_every(detail)}"
    )
    return [figure(svg, f"Residuals of {found.object_id} by sensor.", says)] if svg else []


def _every(detail: ObjectDetail) -> str:
    return f" One of {detail.step} observations is drawn." if detail.step > 1 else ""


def _dots(detail: ObjectDetail, column: str, sigma: str) -> list[Dots]:
    known = detail.seen.drop_nulls(column).sort("sensor_id", "time")
    time_ns = known["time"].dt.epoch("ns")
    x_s, y = seconds_of_day(time_ns.to_numpy()), known[column].to_numpy()
    sigmas = known[sigma] if sigma else pl.Series([None] * len(known), dtype=pl.Float64)
    shown = sigmas.cast(pl.Float64).fill_null(float("nan")).to_numpy()
    names = known["sensor_id"].to_list()
    texts = [
        f"{name} at {clock(t)}, frame {frame}: {value:.2f}"
        + (f" ± {error:.2f}" if error == error else "")
        + (", in the Earth's shadow" if sunlit is False else "")
        for name, t, frame, value, error, sunlit in zip(
            names, time_ns.to_list(), known["frame_number"].to_list(), y.tolist(), shown.tolist(),
            known["sunlit"].to_list(), strict=True,
        )
    ]  # fmt: skip
    first = [k for k in range(len(names)) if k == 0 or names[k] != names[k - 1]]
    return [
        Dots(names[a], x_s[a:b], y[a:b], shown[a:b], texts[a:b])
        for a, b in pairwise([*first, len(names)])
    ]


def _by_sensor(detail: ObjectDetail) -> str:
    rows = [
        (name, f"{count:,}", "" if square is None else f"{square / 2:.2f}")
        for name, count, square in detail.by_sensor.iter_rows()
    ]
    heading = ("sensor", "observations", "mean square / 2")
    return table("By sensor; the mean square should be 1", heading, rows) if rows else ""


def _orbit(detail: ObjectDetail) -> str:
    orbit = detail.orbit
    if orbit is None:
        return nothing("No orbit fits it.")
    rows = [
        (name.rpartition("_")[0] if name.endswith("_deg") else name, with_sigma(value, sigma))
        for name in ELEMENTS
        for value, sigma in ((orbit[name], orbit[f"sigma_{name}"]),)
        if value is not None
    ]
    sigma_km = (orbit["cov_xx"] + orbit["cov_yy"] + orbit["cov_zz"]) ** 0.5
    rows += [
        ("position sigma km", f"{sigma_km:.3g}"),
        ("observations", f"{orbit['n_observations']:,}"),
        ("arc", duration(orbit["arc_s"])),
        ("chi-square of freedoms", f"{orbit['chi2']:.0f} of {orbit['dof']}"),
        ("forces", orbit["forces"]),
    ]
    return table(
        f"Orbit at {orbit['epoch']:%H:%M:%S} UTC, angles in degrees", ("what", "value"), rows
    )
