"""ADES: observations in the IAU's Astrometry Data Exchange Standard, as pipe-separated values.

Fields and their widths: https://github.com/IAU-ADES/ADES-Master, version 2022, file general.xsd.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.ccsds import Subject, as_ascii, times
from epipole.schemas.columns import POSITION, VELOCITY

STATION = "XXX"  # of the Minor Planet Center: one without a code, as all sensors in space of ours
MODE = "UNK"  # which detector a sensor has is not in its log
BAND = "V"
LONGEST_NAME, LONGEST_REMARK = 25, 300  # characters
WIDEST_SIGMA = 7
BRIGHTEST, FAINTEST = -5.0, 35.0
SMALLEST_SIGMA = 1e-4  # a sigma of 0 is not allowed

Texts = npt.NDArray[np.str_]
_UNUSABLE = str.maketrans({"|": "/"})


def observation_file(rows: pl.DataFrame, subjects: Mapping[str, Subject], catalogue: str) -> str:
    """Return observations as the text of a file.

    Parameters
    ----------
    rows
        OBSERVATIONS.
    subjects
        What is known of objects and tracklets, by their ids.
    catalogue
        The star catalogue by its name in ADES, such as Hip2.
    """
    columns = {
        **_identities(rows, subjects),
        **_constant({"mode": MODE, "stn": STATION, "sys": "ICRF_KM", "ctr": "399"}, len(rows)),
        **{f"pos{k}": _decimals(rows[name], 5) for k, name in enumerate(POSITION, 1)},
        **{f"vel{k}": _decimals(rows[name], 7) for k, name in enumerate(VELOCITY, 1)},
        **_position_covariance(rows["position_sigma_km"]),
        "obsTime": np.array([f"{t}Z" for t in times(rows["time"].dt.epoch("ns").to_numpy())], str),
        "ra": _decimals(rows["ra_deg"].round(9) % 360.0, 9),
        "dec": _decimals(rows["dec_deg"], 9),
        "rmsRA": _sigmas(rows["sigma_ra_arcsec"]),
        "rmsDec": _sigmas(rows["sigma_dec_arcsec"]),
        "rmsCorr": _decimals(rows["correlation"].clip(-0.9999, 0.9999), 4),
        **_constant({"astCat": catalogue}, len(rows)),
        **_magnitudes(rows, catalogue),
        "remarks": _remarks(rows),
    }
    lines = map("|".join, zip(*(column.tolist() for column in columns.values()), strict=True))
    return "\n".join(["# version=2022", "|".join(columns), *lines]) + "\n"


def _identities(rows: pl.DataFrame, subjects: Mapping[str, Subject]) -> dict[str, Texts]:
    """Return the international designator of known ones, and a number of each object."""
    names = rows.select(pl.coalesce("object_id", "tracklet_id"))["object_id"].to_list()
    number = {name: f"e{k:07d}" for k, name in enumerate(dict.fromkeys(names), 1)}
    known = {name: _designator(subjects[name]) for name in number if name in subjects}
    return {
        "artSat": np.array([known.get(name, "") for name in names], str),
        "trkSub": np.array([number[name] for name in names], str),
    }


def _designator(subject: Subject) -> str:
    if subject.cospar_id:
        return as_ascii(subject.cospar_id).translate(_UNUSABLE)[:LONGEST_NAME]
    return f"NORAD {subject.norad_id}" if subject.norad_id is not None else ""


def _constant(values: Mapping[str, str], count: int) -> dict[str, Texts]:
    return {name: np.full(count, value) for name, value in values.items()}


def _decimals(values: pl.Series, digits: int) -> Texts:
    """Return numbers with this number of decimals; '' where there is no number."""
    known = values.cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return np.where(np.isfinite(known), np.char.mod(f"%.{digits}f", np.nan_to_num(known)), "")


def _sigmas(values: pl.Series) -> Texts:
    """Return sigmas as wide as they may be."""
    wide = _decimals(values.clip(SMALLEST_SIGMA), WIDEST_SIGMA - 2)
    return np.char.rstrip(wide.astype(f"<U{WIDEST_SIGMA}"), ".")


def _position_covariance(sigma_km: pl.Series) -> dict[str, Texts]:
    variance = np.char.mod("%.6e", sigma_km.to_numpy() ** 2)
    names = ("11", "12", "13", "22", "23", "33")
    return {
        f"posCov{name}": variance if name[0] == name[1] else np.full(len(variance), "0.0")
        for name in names
    }


def _magnitudes(rows: pl.DataFrame, catalogue: str) -> dict[str, Texts]:
    """Return magnitudes with their sigmas; all empty where there is none."""
    mag = rows["magnitude"].cast(pl.Float64)
    known = mag.is_between(BRIGHTEST, FAINTEST).fill_null(value=False).to_numpy()
    texts = {
        "mag": _decimals(mag, 2),
        "rmsMag": _sigmas(rows["magnitude_sigma"].cast(pl.Float64)).astype("<U6"),
        **_constant({"band": BAND, "photCat": catalogue}, len(rows)),
    }
    return {name: np.where(known, text, "") for name, text in texts.items()}


def _remarks(rows: pl.DataFrame) -> Texts:
    """Return which row it is, and what it shares with others."""
    columns = ["object_id", "sensor_id", "tracklet_id", "frame_number", "bias_sigma_arcsec"]
    texts = [
        f"{f'object {found}, ' if found else ''}sensor {sensor}, "
        f"{f'tracklet {tracklet}, ' if tracklet else ''}frame {frame}, "
        f"shared sigma {bias:.3f} arcsec"
        for found, sensor, tracklet, frame, bias in rows.select(columns).iter_rows()
    ]
    return np.array([as_ascii(each).translate(_UNUSABLE)[:LONGEST_REMARK] for each in texts], str)


def catalogue_name(ids: str) -> str:
    """Return the name in ADES of the catalogue whose stars are called so; UNK if unknown."""
    return {"HIP": "Hip2", "Gaia DR3": "Gaia3"}.get(ids, "UNK")
