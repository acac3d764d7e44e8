"""The summary of a run: what people read, what was left out and why, counts of staged nights."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from scenes.associations import filled

from epipole.flows.night import summary as summaries
from epipole.flows.night.summary import Summary, many, summarise
from epipole.io.datasets.night_tables import write_table
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.tables import TABLES

FOUND = Summary(
    dataset="/data/out", nights=["2019-04-01"], logs=1, sensors=2, frames=1234, identified=1200,
    stars=9000, detections=8, tracklets=1, outcomes={"object": 1}, epochs=6, objects=5, positions=4,
    verdicts={"sound": 5}, rejects={}, tracklet_names={},
    mistakes=[], faults=[], by_sensor=[], names={}, residuals=[], unchanged=False, extracts=(),
)  # fmt: skip


def test_a_night_with_nothing_left_out_says_nothing_of_it():
    lines = FOUND.lines()
    assert lines[1] == "frames      1,234 of 2 sensors in 1 log"
    assert lines[3] == "objects     5 in 8 detections, 1 tracklet"
    assert not any("left out" in line or line.startswith("clock") for line in lines)


def test_tracklets_without_object_are_counted_by_outcome():
    from dataclasses import replace

    lines = replace(FOUND, outcomes={"object": 5, "ambiguous": 1, "seen_by_one": 1200}).lines()
    assert lines[4] == "  without   1,201 tracklets: 1 ambiguous, 1,200 seen_by_one"
    assert not any("without" in line for line in FOUND.lines())


def test_objects_that_are_not_sound_are_counted_by_verdict():
    from dataclasses import replace

    lines = replace(FOUND, verdicts={"blended": 1, "no_orbit": 1200, "sound": 3}).lines()
    assert lines[4] == "  not sound 1 blended, 1,200 no_orbit"
    assert not any("not sound" in line for line in FOUND.lines())


def test_each_reason_is_shown_with_its_sentence():
    from dataclasses import replace

    lines = replace(FOUND, rejects={"no_state": 1034, "ambiguous": 2}).lines()
    at = lines.index("left out    1,036:")
    assert lines[at + 1] == f"  1,034 no_state: {Reason.NO_STATE.sentence}"
    assert lines[at + 2] == f"      2 ambiguous: {Reason.AMBIGUOUS.sentence}"


def test_what_needs_a_look_names_its_night_where_there_are_several():
    from dataclasses import replace

    nights = ["2019-04-01", "2019-04-02"]
    found = replace(FOUND, nights=nights, looks={nights[1]: ["no stars"]})
    assert found.needs_look() == ["2019-04-02: no stars"]


def test_counts_have_their_noun():
    assert [many(n, "log") for n in (0, 1, 2000)] == ["0 logs", "1 log", "2,000 logs"]


def staged(folder: Path, **columns) -> Path:
    """A night with these columns; tables without any are empty."""
    for name, schema in TABLES.items():
        values = columns.get(name, {})
        n = len(next(iter(values.values()), [])) if isinstance(values, dict) else 0
        rows = filled(schema, n, values) if isinstance(values, dict) else values
        write_table(folder, name, iter([rows]))
    return folder


def test_staged_nights_are_counted_together(tmp_path):
    first = staged(
        tmp_path / "1",
        frames={
            "sensor_id": ["a", "a", "b"], "attitude_source": ["stars", "prior", "none"],
            "residual_px": pa.array([0.25, None, None]), "n_stars": [4, 0, 0],
        },
        tracklets={
            "sensor_id": ["a", "a", "b"], "track_id": ["t", "t", "u"],
            "outcome": ["seen_by_one", "object", "seen_by_one"],
        },
        epochs={"epoch": [1, 1, 2]},
        positions={"object_id": ["o", "p", "o"]},
        objects={"object_id": ["o", "p"], "verdict": ["sound", "blended"]},
        sources={"sha256": ["s"]},
        stars={"centroid": np.arange(4)},
        nights={"faults": [["the clock of a is late"]]},
        checks={"sensor_id": ["a", "b"], "check": ["velocity"] * 2, "cause": ["zero"] * 2,
                "verdict": ["wrong", "unknown"], "sentence": ["0 for unknown", ""]},
    )  # fmt: skip
    reasons = [Reason.NAN, Reason.NO_STATE, Reason.BAD_SIGMA, Reason.NO_STATE]
    second = staged(
        tmp_path / "2",
        rejects=reject_rows(reasons, time=[1, 2, 3, 4], count=[3, 8, 3, 1]),
        frames={
            "sensor_id": ["a"], "attitude_source": ["stars"], "residual_px": pa.array([0.75]),
            "n_stars": [0], "time": [7_000_000_000],
        },
        positions={"object_id": ["o"]},
        objects={"object_id": ["o"], "verdict": ["sound"]},
        sources={"sha256": ["s"]},
        nights={"faults": [[]]},
    )  # fmt: skip
    summary = summarise("/data", {"2019-04-01": first, "2019-04-02": second})
    assert (summary.logs, summary.sensors, summary.frames) == (1, 2, 4)
    assert (summary.identified, summary.stars, summary.tracklets) == (2, 4, 3)
    assert summary.outcomes == {"object": 1, "seen_by_one": 2}
    assert (summary.epochs, summary.objects, summary.positions) == (2, 2, 4)
    assert summary.verdicts == {"blended": 1, "sound": 2}
    # The most frequent first, then by name.
    assert list(summary.rejects.items()) == [("no_state", 9), ("bad_sigma", 3), ("nan", 3)]
    assert summary.mistakes == ["2019-04-01: a: 0 for unknown"]
    assert summary.faults == ["2019-04-01: the clock of a is late"]
    rows = [sensor.as_row() for sensor in summary.by_sensor]
    assert rows == [
        {
            "sensor": "a", "frames": 3, "identified": 2, "identified %": "66.7",
            "longest gap s": "7", "residual px": "0.500", "tracks": 1,
        },
        {
            "sensor": "b", "frames": 1, "identified": 0, "identified %": "0.0",
            "longest gap s": "", "residual px": "", "tracks": 1,
        },
    ]  # fmt: skip
    assert summary.as_dict()["by_sensor"][1]["residual_px"] is None


def test_each_table_is_read_once(tmp_path, monkeypatch):
    read, names = summaries.read_columns, []

    def counted(folder, name, columns):
        names.append(name)
        return read(folder, name, columns)

    monkeypatch.setattr(summaries, "read_columns", counted)
    summarise("/data", {"2019-04-01": staged(tmp_path, nights={"faults": [[]]})})
    assert sorted(names) == sorted(set(names))
