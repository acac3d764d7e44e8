"""Element sets to test with: the space station, and made-up satellites."""

import math

from sgp4.api import WGS72, Satrec
from sgp4.exporter import export_tle

from epipole.schemas.star_lists import ElementSet

# CelesTrak, 30 May 2026.
LINES = (
    "1 25544U 98067A   26150.51748228  .00011776  00000+0  21767-3 0  9998",
    "2 25544  51.6337  27.5746 0007245 114.7080 245.4664 15.49496548569014",
)
EPOCH_NS = 1_780_143_910_468_992_000


def element_set(satellite, name=""):
    """Return the elements of a satellite of sgp4."""
    days = satellite.jdsatepoch - 2433281.5 + satellite.jdsatepochF
    names = ("bstar", "ndot", "nddot", "ecco", "argpo", "inclo", "mo", "no_kozai", "nodeo")
    elements = (days, *(getattr(satellite, n) for n in names))
    seconds = round((satellite.jdsatepoch - 2440587.5) * 86400)
    epoch_ns = seconds * 10**9 + round(satellite.jdsatepochF * 86400 * 10**6) * 1000
    return ElementSet(name, satellite.satnum, epoch_ns, elements)


def two_lines(number, turns_a_day, *, bstar=0.0, e=0.001, days=0.0):
    """Return the two lines of a made-up satellite."""
    satellite = Satrec()
    epoch = 27909.5 + days  # 30 May 2026, 12h
    motion = turns_a_day * 2 * math.pi / 1440
    satellite.sgp4init(
        WGS72, "i", int(number), epoch, bstar, 0.0, 0.0, e, 1.0, 1.5, 2.0, motion, 0.3
    )
    return export_tle(satellite)


ISS = element_set(Satrec.twoline2rv(*LINES), "ISS (ZARYA)")
