"""Known objects in a run: names from a catalogue, bad catalogues, names of a night before."""

import datetime
import json
import logging

import numpy as np
import polars as pl
import pytest
from scenes.aged_elements import aged
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import read_table
from epipole.io.simulation.scenes import read_element_sets
from epipole.schemas.errors import CatalogueError

pytestmark = pytest.mark.long

NIGHT = "2026-05-30"
DAYS, EPOCH_OF_DAYS = 27909.0, np.datetime64("2026-05-30T00:00:00.000000")
DAY_US = 86_400_000_000
ANGLES = ("INCLINATION", "RA_OF_ASC_NODE", "ARG_OF_PERICENTER", "MEAN_ANOMALY")
NOON_NS = 1_780_142_400_000_000_000


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("known") / "log.mcap"
    simulate("real_geo", path, seed=9, hours=0.1)
    return path


def as_omm(sets):
    """The sets as OMM in JSON."""
    messages = []
    for each in sets:
        epoch_days, bstar, _, _, e, argument, inclination, anomaly, motion, node = each.elements
        epoch = EPOCH_OF_DAYS + round((epoch_days - DAYS) * DAY_US) * np.timedelta64(1, "us")
        angles = dict(zip(ANGLES, np.degrees([inclination, node, argument, anomaly]), strict=True))
        messages.append(
            {"OBJECT_NAME": each.name, "NORAD_CAT_ID": each.number, "OBJECT_ID": each.cospar_id,
             "EPOCH": str(epoch), "MEAN_MOTION": motion * 1440 / (2 * np.pi), "ECCENTRICITY": e,
             "BSTAR": bstar, "MEAN_MOTION_DOT": 0, "MEAN_MOTION_DDOT": 0, **angles}
        )  # fmt: skip
    return json.dumps(messages)


def rows_of(dataset, night=NIGHT, table="identifications"):
    return pl.DataFrame(read_table(dataset, table, night))


def test_two_thirds_of_an_aged_catalogue_are_named_and_the_rest_is_unknown(log, tmp_path):
    rng = np.random.default_rng(1)
    sets = read_element_sets("real_geo.tle")
    known = aged(sets, NOON_NS, rng.uniform(0.3, 3.0, len(sets)), rng)
    listed = known[: 2 * len(known) // 3]
    (tmp_path / "catalogue.json").write_text(as_omm([*listed, listed[0], sets[-1]._replace(
        number=1, epoch_ns=0, elements=(1.0, *sets[-1].elements[1:]))]))  # fmt: skip
    out = tmp_path / "out"
    summary = nightly(str(log), str(out), known=str(tmp_path / "catalogue.json"))
    rows = rows_of(out)
    assert rows["object_id"].to_list() == sorted(set(rows_of(out, table="positions")["object_id"]))
    assert set(rows["status"]) == {"known", "unknown"}
    assert (
        rows.filter(pl.col("status") == "known")["norad_id"]
        .is_in([each.number for each in listed])
        .all()
    )
    assert summary.names == dict(rows["status"].value_counts().sort("status").iter_rows())
    assert len(summary.residuals) == summary.sensors
    rejects = rows_of(out, table="rejects").filter(pl.col("stage") == "name")
    assert set(rejects["reason"]) == {"other_elements", "old_elements"}
    assert rejects["source"].to_list() == ["catalogue.json"] * 2
    times = rows_of(out, table="checks").filter(pl.col("check") == "utc_times")
    assert len(times) == summary.sensors
    assert set(times["verdict"]) == {"sound"}
    assert (times["value"].abs() < 3 * times["sigma"]).all()


def test_an_old_catalogue_is_told_in_one_line_and_names_nothing(log, tmp_path, caplog):
    sets = read_element_sets("real_geo.tle")
    old = [
        each._replace(elements=(each.elements[0] - 365, *each.elements[1:])) for each in sets[:3]
    ]
    (tmp_path / "old.json").write_text(as_omm(old))
    with caplog.at_level(logging.WARNING, "epipole"):
        summary = nightly(str(log), str(tmp_path / "out"), known=str(tmp_path / "old.json"))
    assert set(summary.names) == {"unknown"}
    (line,) = [r.getMessage() for r in caplog.records if "old.json" in r.getMessage()]
    assert line == ("old.json: no element set is within 30 days of 2026-05-30 (the newest is of "
                    "2025-05-30): no object is named")  # fmt: skip


def test_a_catalogue_that_is_none_ends_a_run_before_it_begins(log, tmp_path, no_early_server):
    (tmp_path / "none.tle").write_text("")
    with pytest.raises(CatalogueError, match="has no element sets"):
        nightly(str(log), str(tmp_path / "out"), known=str(tmp_path / "none.tle"))
    asked = ["run", str(log), "--out", str(tmp_path / "out"), "--known"]
    for name in ("none.tle", "missing.tle"):
        result = CliRunner().invoke(app, [*asked, str(tmp_path / name)])
        assert result.exit_code == 1
        (line,) = result.output.splitlines()
        assert name in line
        assert "give two-line elements, or OMM" in line
    assert not (tmp_path / "out").exists()


def test_an_unknown_object_has_its_id_of_the_night_before(tmp_path):
    logs = []
    for day, hour in ((30, 20), (31, 3)):
        logs.append(tmp_path / f"{day}.mcap")
        start = datetime.datetime(2026, 5, day, hour, tzinfo=datetime.UTC)
        simulate("real_geo", logs[-1], seed=9, hours=0.2, start=start)
    out = tmp_path / "out"
    for each in logs:
        nightly(str(each), str(out), known=None)
    rows = rows_of(out, "2026-05-31")
    recognised = rows.drop_nulls("same_as")
    # After seven hours arcs of twelve minutes leave 100 km: satellites of one slot are not decided.
    assert len(recognised) >= 5
    # Each is the satellite that it was: held against the true elements, in both nights.
    elements = tmp_path / "true.json"
    elements.write_text(as_omm(read_element_sets("real_geo.tle")))
    numbers = {}
    for each in logs:
        nightly(str(each), str(tmp_path / "named"), known=str(elements))
    for night in ("2026-05-30", "2026-05-31"):
        named = rows_of(tmp_path / "named", night)
        numbers |= dict(zip(named["object_id"], named["norad_id"], strict=True))
    for new, old in recognised.select("object_id", "same_as").iter_rows():
        assert numbers[new] == numbers[old]
