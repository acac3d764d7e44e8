"""Rows of `rejects` while a log is read: few for what is alike, and bounded in all."""

from epipole.io.logs import left_out as damage
from epipole.io.logs.left_out import ROWS_ALIKE, RejectList
from epipole.schemas.bridge import rows_of
from epipole.schemas.rejects import Reason


def rows(rejects):
    return [(r["offset"], r["sensor_id"], r["reason"], r["count"])
            for r in rows_of(rejects.table(None))]  # fmt: skip


def test_of_rows_that_are_alike_the_last_one_counts_the_others():
    rejects = RejectList("a.mcap")
    for _ in range(ROWS_ALIKE + 5):
        rejects.add(Reason.NAN, time_ns=0, offset=7, sensor_id="a", count=2)
    assert rows(rejects) == [(7, "a", "nan", 2)] * (ROWS_ALIKE - 1) + [(7, "a", "nan", 12)]


def test_behind_the_last_row_each_reason_has_one_that_counts_the_rest(monkeypatch):
    monkeypatch.setattr(damage, "MAX_ROWS", 3)
    rejects = RejectList("a.mcap")
    for offset in range(10):
        rejects.add(Reason.NAN, time_ns=0, offset=offset, sensor_id="a")
        rejects.add(Reason.BAD_SIGMA, time_ns=0, offset=offset, sensor_id="a")
    rejects.add(Reason.NAN, time_ns=0, offset=0, sensor_id="a", count=5)  # it has a row
    assert rows(rejects) == [
        (0, "a", "nan", 6),
        (0, "a", "bad_sigma", 1),
        (1, "a", "nan", 1),
        (None, None, "bad_sigma", 9),
        (None, None, "nan", 8),
    ]
