"""Two weeks of short nights with planned mishaps: each is seen in every place, nothing else is."""

import datetime
import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from scenes.altered_logs import frame_values, state_values, table_rows
from typer.testing import CliRunner

from epipole.flows import nightly as flow
from epipole.flows.command_line.main import app
from epipole.flows.nightly import nightly
from epipole.flows.prefect import artifacts
from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter
from epipole.schemas.given_settings import validate_settings

SECOND_NS, DAY_NS = 1_000_000_000, 86_400_000_000_000
FAST = {"linking": {"enabled": False}}
PLAIN = validate_settings(FAST, "test")
OTHER = validate_settings(FAST | {"sensors": {"state_gap_s": 29.0}}, "test")

NIGHTS = 14  # eight with mishaps, then more than the five that a trend needs

pytest.importorskip("matplotlib")
pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prefect")]


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """Return what two sensors see in 20 s of the first night."""
    log = tmp_path_factory.mktemp("sky") / "sky.mcap"
    start = datetime.datetime(2019, 4, 1, 4, tzinfo=datetime.UTC)
    simulate("four_sensor_geo", log, seed=7, objects=3, seconds=20, start=start)
    return read_log(log)


def write(path: Path, sky, day: int, shares: dict[str, float]) -> Path:
    """Write the log of a night: the sky of the first one, some days later: shares of the frames."""
    shift_ns = (day - 1) * DAY_NS
    cameras, states, exposures = map(table_rows, (sky.cameras, sky.states, sky.exposures))
    with LogWriter(path, chunk_size=2000) as out:
        for row in [row for row in cameras if row["sensor_id"] in shares]:
            out.camera(row["sensor_id"], row.pop("time_ns") + shift_ns, row)
        for row in map(state_values, [row for row in states if row["sensor_id"] in shares]):
            out.state(row.pop("sensor_id"), row.pop("time_ns") + shift_ns, **row)
        rows = list(map(frame_values, exposures))
        for sensor, share in shares.items():
            of_sensor = [row for row in rows if row["sensor_id"] == sensor]
            for row in of_sensor[: round(share * len(of_sensor))]:
                values = {k: v for k, v in row.items() if k not in ("sensor_id", "time_ns")}
                out.frame(sensor, row["time_ns"] + shift_ns, **values)
    return path


class Month:
    """A folder of logs, a dataset, and what was told of its nights."""

    def __init__(self, folder: Path, sky, monkeypatch) -> None:
        self.logs, self.out, self.sky = folder / "logs", folder / "out", sky
        self.logs.mkdir()
        self.names = sorted(set(sky.exposures["sensor_id"].to_pylist()))[:2]
        self.alerts: list[tuple[str, str]] = []
        self.messages: dict[str, str] = {}
        self._patch = monkeypatch
        monkeypatch.setattr(artifacts, "deployment", SimpleNamespace(id="a deployment"))
        monkeypatch.setattr(artifacts, "emit_event", self._hear)

    def _hear(self, event: str, resource: dict[str, str]) -> None:
        assert event == "epipole.night.needs-look"
        night = resource["prefect.resource.id"].removeprefix("epipole.night.")
        self.alerts.append((night, resource["epipole.message"]))

    def log(self, day: int, **shares: float) -> Path:
        chosen = shares or dict.fromkeys(self.names, 1.0)
        return write(self.logs / f"n{day:02}.mcap", self.sky, day, chosen)

    def morning(self, day: int, settings=PLAIN) -> str:
        """Run as the deployment does the morning after a night; return the state's message."""
        night = f"2019-04-{day:02}"
        self._patch.setattr(flow, "night_asked", lambda _: night)
        state = nightly(
            str(self.logs), str(self.out), settings, night="yesterday", return_state=True
        )
        self.messages[night] = f"{state.type.value}: {state.message}"
        return self.messages[night]

    def calendar(self) -> set[str]:
        """Return the days that need a look, by the calendar."""
        page = self.out / "nights.html"
        ended = CliRunner().invoke(app, ["report", str(self.out), "--out", str(page)])
        assert ended.exit_code == 0, ended.output
        text = page.read_text()
        page.unlink()
        return set(re.findall(r'class="night bad[^>]*2019-04-(\d\d)', text))

    def nights(self, *options: str) -> str:
        ended = CliRunner().invoke(app, ["nights", str(self.out), *options])
        assert ended.exit_code == 0, ended.output
        return ended.stdout


def test_each_mishap_is_seen_everywhere_and_nothing_else_is(tmp_path, sky, monkeypatch):
    month = Month(tmp_path, sky, monkeypatch)
    a, b = month.names
    month.log(1)
    month.morning(1)
    month.log(2, **{a: 1.0})  # an absent sensor
    with LogWriter(month.logs / "empty.mcap"):
        pass
    (month.logs / "broken.mcap").write_bytes(b"no log")
    month.morning(2)
    month.log(3, **{a: 1.0, b: 0.3})  # half a night
    month.morning(3)
    month.morning(4)  # its log comes late
    month.log(4)
    month.log(5)
    whole = month.log(7).read_bytes()
    (month.logs / "n07.mcap").write_bytes(whole[: len(whole) // 3])  # still written
    month.morning(5)
    month.morning(6)  # an empty night
    (month.logs / "n07.mcap").write_bytes(whole)
    month.log(8)
    monkeypatch.setattr(flow, "solve", _fail_once(flow.solve))
    month.morning(7)  # fails
    month.morning(8, OTHER)  # other settings: the last nights are made again
    for day in range(9, NIGHTS + 1):
        month.log(day)
        month.morning(day, OTHER)

    broken = "broken.mcap is no MCAP file; it is on no night"
    empty = "empty.mcap has nothing that can be used; it is on no night"
    absent = f"{b}: no frames in the whole night"
    half = f"{b}: no frames for"
    told = {
        "2019-04-02": [absent, broken, empty], "2019-04-03": [half], "2019-04-04": ["no frames"],
        "2019-04-06": ["no frames"], "2019-04-07": [],
    }  # fmt: skip
    alerts = {night: [m for n, m in month.alerts if n == night] for night, _ in month.alerts}
    assert {n: len(messages) for n, messages in alerts.items()} == dict.fromkeys(
        (n for n in told if told[n]), 1
    ), month.alerts
    listed = month.nights()
    for night, sentences in told.items():
        for sentence in sentences:
            assert sentence in alerts[night][0]
            assert sentence in month.messages[night]
            assert sentence in listed or night == "2019-04-04"  # it was made since
    sound = [night for night in month.messages if night not in told]
    assert len(sound) == NIGHTS - len(told)
    for night in sound:
        assert "needs a look" not in month.messages[night]
    assert "2019-04-04 made" in month.messages["2019-04-05"]
    assert month.messages["2019-04-07"] == "FAILED: the disk is full"
    assert "2019-04-07 made" in month.messages["2019-04-08"]
    assert month.messages["2019-04-06"].startswith("COMPLETED: no frames")

    rows = {row["night"]: row for row in json.loads(month.nights("--json"))["nights"]}
    states = {night[-2:]: row["state"] for night, row in rows.items()}
    made = {f"{day:02}": "made" for day in range(1, NIGHTS + 1)}
    assert states == made | {"06": "no frames"}
    assert month.calendar() == {"02", "03"}  # the late and the failed night were made since
    assert rows["2019-04-08"]["settings"] == [
        "sensors.state_gap_s = 29.0", "linking.enabled = False",
    ]  # fmt: skip
    assert "other settings" in rows["2019-04-01"]["stale"]
    assert rows["2019-04-02"]["sensor_ids"] == [a]
    text = (month.out / "runs" / "last.prom").read_text()
    assert f'epipole_run_made{{night="2019-04-{NIGHTS}"}} 1' in text
    assert text.endswith("# EOF\n")


def _fail_once(solve):
    from epipole.schemas.errors import DatasetError

    calls = []

    def failing(*arguments):
        calls.append(1)
        if len(calls) == 1:
            raise DatasetError("the disk is full")
        return solve(*arguments)

    return failing
