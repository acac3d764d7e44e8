"""Nights whose logs have bad values, stray clocks or no frames: what is good is published."""

from pathlib import Path

import polars as pl
import pytest
from scenes.altered_logs import altered

from epipole.flows.nightly import nightly
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import LogError

EXAMPLE = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"
DAY_NS = 86_400_000_000_000
SPEED_OF_LIGHT_KM_S = 299_792.458


def bad_frame(row):
    """The first frame says 1990; every twentieth one is on a day of its own."""
    if row["number"] == 0:
        return {"time_ns": 7300 * DAY_NS}
    return {} if row["number"] % 20 else {"time_ns": row["time_ns"] + row["number"] * DAY_NS}


def bad_state(row):
    speed = {"velocity_km_s": [SPEED_OF_LIGHT_KM_S, 0.0, 0.0]}
    return {"attitude_sigma_arcsec": 36_000.0, **({} if row["number"] % 10 else speed)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of folders: a log of bad values, one of states alone, one that is cut."""
    logs = tmp_path_factory.mktemp("logs")
    (logs / "states" / "late").mkdir(parents=True)
    altered(EXAMPLE, logs / "bad.mcap", frame=bad_frame, state=bad_state)
    cut = logs / "states" / "cut.mcap"
    cut.write_bytes(EXAMPLE.read_bytes()[:100])
    states = logs / "states" / "late" / "states.mcap"
    with LogWriter(states) as log:
        log.state("sat9", 1_554_091_200_000_000_000, position_km=[7000.0, 0.0, 0.0])
    return logs


@pytest.mark.long
def test_bad_values_cost_themselves_and_no_night(prefect, folder, tmp_path):
    out = tmp_path / "out"
    for _ in range(2):  # the second run replaces the night, and is not refused
        found = nightly(str(folder), str(out))
    assert found.nights == ["2019-04-01"]
    assert found.objects == 9
    assert found.identified > 200
    counts = {"stray_time": 12, "vague_attitude": 234, "bad_velocity": 26, "nothing_read": 1}
    assert found.rejects.items() >= counts.items()
    sources = pl.read_parquet(out / "night=2019-04-01" / "sources" / "*.parquet")
    assert sorted(sources["name"]) == ["bad.mcap", "states.mcap"]


def test_a_night_without_any_frame_is_an_error_that_says_what_was_left_out(
    prefect, folder, tmp_path
):
    with pytest.raises(LogError, match=r"no frames in these logs; record"):
        nightly(str(folder / "states"), str(tmp_path / "out"))
