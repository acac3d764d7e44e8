"""The globe as SVG, seen from far away (orthographic); page.js turns it.

Each dot and line has its coordinates in space, so that page.js can draw it from another side.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from epipole.schemas.arrays import Array, Flags
from epipole.schemas.text import as_line
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM
from epipole.tasks.report.canvas import LONGEST_TEXT
from epipole.tasks.report.globe import Globe, Sight

SIZE_PT = 266.0  # as wide as the other pictures
MARGIN_PT = 8.0
# It is seen at first from where most dots are seen, and farthest apart from each other.
LATITUDES_DEG, LONGITUDES_DEG = range(-60, 61, 20), range(0, 360, 15)
FARTHEST_KM = 60_000.0  # what is farther away is outside the picture until it is made smaller
STEPS = 6  # parts of a line of sight, each of which may be behind the Earth; page.js has it too


class _Side(NamedTuple):
    """From where the globe is seen [deg], and points of the picture per 1,000 km."""

    longitude: float
    latitude: float
    scale: float

    def project(self, r_km: Array) -> tuple[Array, Flags]:
        """Return points of the picture (n, 2), and which are before the Earth or beside it."""
        lon, lat = np.radians([self.longitude, self.latitude])
        right = np.array([-np.sin(lon), np.cos(lon), 0.0])
        towards = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        up = np.cross(towards, right)
        x, y, depth = r_km @ right, r_km @ up, r_km @ towards
        seen = (depth >= 0.0) | (np.hypot(x, y) > EARTH_RADIUS_KM)
        middle, unit = SIZE_PT / 2, self.scale / 1000
        return np.stack([middle + unit * x, middle - unit * y], axis=1), seen


def draw_globe(globe: Globe, about: Mapping[str, str], anchors: Mapping[str, str]) -> str:
    """Return the picture of a globe; `about` is the line about each object."""
    dots = np.array([*globe.sensors.values(), *globe.objects.values()]).reshape(-1, 3)
    farthest = min(float(np.linalg.norm(dots, axis=1).max(initial=EARTH_RADIUS_KM)), FARTHEST_KM)
    scale = (SIZE_PT / 2 - MARGIN_PT) / farthest * 1000
    side = _best_side(dots, scale)
    radius = EARTH_RADIUS_KM * scale / 1000
    parts = [
        f'<circle class="earth" cx="{SIZE_PT / 2:g}" cy="{SIZE_PT / 2:g}" r="{radius:.2f}"/>',
        _lines("grid", side, _graticule()),
        _sights("sight", side, [s for s in globe.sights if s.object_id]),
        _sights("sight lone", side, [s for s in globe.sights if not s.object_id]),
        _dots("blue", "mark2", side, (
            (f"{name}, {_height(r_km)}", "", r_km) for name, r_km in globe.sensors.items())),
        _dots("vermillion", "mark0", side, (
            (f"{about.get(name, name)}, {_height(r_km)}", anchors.get(name, ""), r_km)
            for name, r_km in globe.objects.items())),
    ]  # fmt: skip
    return (
        f'<svg viewBox="0 0 {SIZE_PT:g} {SIZE_PT:g}" xmlns="http://www.w3.org/2000/svg" '
        f'data-turn="{side.longitude:g} {side.latitude:g}" data-scale="{scale:.5g}">'
        f"{''.join(parts)}</svg>"
    )


def _best_side(dots: Array, scale: float) -> _Side:
    def shows(side: _Side) -> tuple[int, float]:
        points, seen = side.project(dots)
        return int(seen.sum()), float(points[seen].var(axis=0).sum()) if seen.any() else 0.0

    sides = [_Side(float(x), float(y), scale) for y in LATITUDES_DEG for x in LONGITUDES_DEG]
    return max(sides, key=shows)


def _graticule() -> list[Array]:
    """Return parallels and meridians, every 30 degrees of GCRF [km]."""
    turn, half = np.radians(np.arange(0, 361, 10)), np.radians(np.arange(-90, 91, 10))
    lines = [(turn, np.full(len(turn), lat)) for lat in np.radians([-60, -30, 0, 30, 60])]
    lines += [(np.full(len(half), lon), half) for lon in np.radians(np.arange(0, 360, 30))]
    return [
        EARTH_RADIUS_KM
        * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
        for lon, lat in lines
    ]


def _lines(kind: str, side: _Side, lines: Iterable[Array]) -> str:
    parts = [f'<path d="{_drawn(side, line)}" data-p="{_in_space(line)}"/>' for line in lines]
    return f'<g class="{kind}">{"".join(parts)}</g>'


def _sights(kind: str, side: _Side, sights: Iterable[Sight]) -> str:
    parts = []
    for sight in sights:
        ends = np.stack([sight.from_km, sight.to_km])
        line = ends[0] + np.linspace(0.0, 1.0, STEPS + 1)[:, None] * (ends[1] - ends[0])
        parts.append(f'<path d="{_drawn(side, line)}" data-p="{_in_space(ends)}"/>')
    return f'<g class="{kind}">{"".join(parts)}</g>'


def _drawn(side: _Side, line: Array) -> str:
    """Return a line without its parts behind the Earth."""
    points, seen = side.project(line)
    drawn, before = [], False
    for (x, y), is_seen in zip(points.tolist(), seen.tolist(), strict=True):
        if is_seen:
            drawn.append(f"{'L' if before else 'M'}{x:.1f} {y:.1f}")
        before = is_seen
    return "".join(drawn)


def _dots(colour: str, mark: str, side: _Side, dots: Iterable[tuple[str, str, Array]]) -> str:
    parts = []
    for says, anchor, r_km in dots:
        ((x, y),), (seen,) = side.project(r_km[None])
        leads = f" data-h={quoteattr(anchor)}" if anchor else ""
        hidden = "" if seen else ' visibility="hidden"'
        text = quoteattr(as_line(says, LONGEST_TEXT))
        parts.append(
            f'<use href="#{mark}" x="{x:.1f}" y="{y:.1f}" data-p="{_in_space(r_km)}" '
            f"data-t={text}{leads}{hidden}/>"
        )
    return f'<g style="fill: var(--{colour})">{"".join(parts)}</g>'


def _in_space(r_km: Array) -> str:
    """Return coordinates in units of 1,000 km."""
    return " ".join(f"{value:.3f}" for value in (r_km / 1000).ravel().tolist())


def _height(r_km: Array) -> str:
    return f"{float(np.linalg.norm(r_km)) - EARTH_RADIUS_KM:,.0f} km high"
