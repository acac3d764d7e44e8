"""The report of an evaluation: a dataset compared with the truth of a simulated log."""

import math
from dataclasses import dataclass, field, fields
from typing import Any


def _measure(group: str, label: str, style: str = "count") -> Any:
    return field(default=None, metadata={"group": group, "label": label, "style": style})


@dataclass(frozen=True)
class Report:
    """The measures of an evaluation. None: there was nothing to measure.

    Shares are 0 to 1: of the rows in the dataset (precision, purity) or of the rows in the truth
    (recall, completeness). Attitude errors are in arcseconds about the sensor axes. Position
    errors are in kilometres, against the object's true position at the position's `time`.
    """

    frames: int | None = _measure("frames", "in the dataset")
    frames_duplicated: int | None = _measure("frames", "more than once")
    frames_solved: float | None = _measure("frames", "attitude from stars", "share")

    stars_claimed: int | None = _measure("stars", "claimed")
    star_precision: float | None = _measure("stars", "precision", "share")
    star_recall: float | None = _measure("stars", "recall", "share")

    att_cross_arcsec_median: float | None = _measure("attitude", "boresight, median", "arcsec")
    att_cross_arcsec_p99: float | None = _measure("attitude", "boresight, 99 %", "arcsec")
    att_roll_arcsec_median: float | None = _measure("attitude", "roll, median", "arcsec")
    att_wrong: int | None = _measure("attitude", "wrong (error above 6', roll 30')")

    epochs: int | None = _measure("associations", "epochs")
    groups: int | None = _measure("associations", "objects reported at epochs")
    pair_precision: float | None = _measure("associations", "pair precision", "share")
    pair_recall: float | None = _measure("associations", "pair recall", "share")
    object_recall: float | None = _measure("associations", "object recall", "share")
    ghosts: int | None = _measure("associations", "ghosts")

    positions: int | None = _measure("positions", "of true objects")
    positions_of_ghosts: int | None = _measure("positions", "of ghosts")
    positions_per_truth: float | None = _measure(
        "positions", "per interval with two sensors", "share"
    )
    pos_err_km_median: float | None = _measure("positions", "error, median", "km")
    pos_err_km_p95: float | None = _measure("positions", "error, 95 %", "km")
    pos_err_km_max: float | None = _measure("positions", "error, largest", "km")
    axis_rms_km: tuple[float, float, float] | None = _measure("positions", "rms x, y, z", "km")
    nees_median: float | None = _measure("positions", "NEES, median (expected: 2.37)", "number")
    nees_in_99: float | None = _measure("positions", "in the 99 % ellipsoid", "share")
    ids_per_target: float | None = _measure("positions", "ids per object", "number")
    longest_id_share: float | None = _measure("positions", "share of the main id", "share")

    tracks: int | None = _measure("tracks", "tracks")
    track_purity: float | None = _measure("tracks", "purity", "share")
    track_completeness: float | None = _measure("tracks", "completeness", "share")
    tracks_per_target: float | None = _measure("tracks", "tracks per object and sensor", "number")

    def as_dict(self) -> dict[str, Any]:
        """Return the measures by name, as JSON takes them."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    def rows(self) -> list[tuple[str, str, str]]:
        """Return group, measure and value of all that there is, as people read them."""
        return [
            (f.metadata["group"], f.metadata["label"], _text(value, f.metadata["style"]))
            for f in fields(self)
            if (value := getattr(self, f.name)) is not None
        ]


def _text(value: Any, style: str) -> str:
    if isinstance(value, tuple):
        return ", ".join(_text(v, "bare") for v in value) + " km"
    if style == "share":  # rounded down: 100.00% means all
        value = math.floor(value * 1e4 + 1e-9) / 1e4
    form = {
        "count": "{:,}",
        "share": "{:.2%}",
        "arcsec": "{:.2f} arcsec",
        "km": "{:.4f} km",
        "bare": "{:.4f}",
        "number": "{:.2f}",
    }[style]
    return form.format(value)
