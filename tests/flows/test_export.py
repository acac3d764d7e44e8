"""Export: what a night's tables say, as messages; all files or none, errors for people."""

import re
import shutil

import ccsds_ndm as ccsds
import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from scenes.screening import faults_of

from epipole.flows.export import Wanted, export
from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.schemas.errors import DatasetError
from epipole.schemas.options import Message, MessageForm, MessageFrame
from epipole.tasks.algorithms.orbits.reference_frames import orientation_at, to_gcrf

NIGHT = "2019-04-01"

# EME2000 from GCRF as a small rotation: IERS Conventions (2010), equation 5.21 and after.
FRAME_BIAS = np.radians(np.array([6.8192, -16.617, -14.6]) / 3.6e6)


def directions(ra_deg, dec_deg):
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)


def observed(dataset, table="observations"):
    return pl.read_parquet(dataset / f"night={NIGHT}/{table}/*.parquet")


def test_tracking_data_are_the_observations_and_their_sensors_places(night_dataset, tmp_path):
    files = export(Message.tdm, str(night_dataset), NIGHT, tmp_path / "out")
    rows = observed(night_dataset).drop_nulls("object_id")
    objects, sensors = sorted(set(rows["object_id"])), sorted(set(rows["sensor_id"]))
    assert files == sorted([*(f"{o}.tdm" for o in objects), *(f"{s}.oem" for s in sensors)])
    message = ccsds.Tdm.from_file(str(tmp_path / "out" / f"{objects[0]}.tdm"))
    own = rows.filter(pl.col("object_id") == objects[0]).sort("sensor_id", "time")
    rows = [o for s in message.segments for o in s.data.observations]
    ra, dec = (np.array([o.value for o in rows if o.keyword == f"ANGLE_{k}"]) for k in "12")
    gcrf = directions(own["ra_deg"].to_numpy(), own["dec_deg"].to_numpy())
    off = directions(ra, dec) - (gcrf - np.cross(FRAME_BIAS, gcrf))
    assert np.abs(off).max() < 1e-10
    states = ccsds.Oem.from_file(str(tmp_path / "out" / f"{sensors[0]}.oem")).segments[0].data
    first = own.filter(pl.col("sensor_id") == sensors[0]).row(0, named=True)
    epoch = first["time"].strftime("%Y-%m-%dT%H:%M:%S")
    near = [v.x for v in states.state_vector if v.epoch.startswith(epoch)]
    assert np.isclose(near, first["x_km"], rtol=0, atol=1e-6).any()


def test_observations_as_ades_are_all_of_them_or_those_asked_for(night_dataset, tmp_path):
    rows = observed(night_dataset)
    files = export(Message.ades, str(night_dataset), NIGHT, tmp_path / "all")
    assert files == [f"{NIGHT}.psv"]
    lines = (tmp_path / "all" / files[0]).read_text().splitlines()
    # Rows of an object's tracklet that do not show it are left out, as in a TDM.
    alone = rows.filter(pl.col("object_id").is_null().all().over("tracklet_id"))
    assert len(lines) - 2 == len(rows.drop_nulls("object_id")) + len(alone)
    assert {line.split("|")[lines[1].split("|").index("astCat")] for line in lines[2:]} == {"Hip2"}
    name = rows["object_id"].drop_nulls()[0]
    export(Message.ades, str(night_dataset), NIGHT, tmp_path / "one", Wanted([name]))
    lines = (tmp_path / "one" / files[0]).read_text().splitlines()
    assert len(lines) - 2 == len(rows.filter(object_id=name))
    assert all(f"object {name}, " in line for line in lines[2:])
    with pytest.raises(DatasetError, match="has no observations of nobody"):
        export(Message.ades, str(night_dataset), NIGHT, tmp_path / "none", Wanted(["nobody"]))


# Times and names of files; comments, which the reader of KVN takes for the header's; and values
# that are the default of the standard, which XML leaves out.
UNLIKE = "(CREATION_DATE|EPHEMERIS_NAME|COMMENT|SCLK_|ORB_REVNUM_BASIS|ORB_AVERAGING).*"


@pytest.mark.parametrize(
    ("kind", "reader"),
    [(Message.tdm, ccsds.Tdm), (Message.oem, ccsds.Oem), (Message.opm, ccsds.Opm),
     (Message.ocm, ccsds.Ocm)],
)  # fmt: skip
def test_xml_says_what_kvn_says(kind, reader, night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]
    texts = []
    for form in MessageForm:
        wanted = Wanted([name], form=form)
        files = export(kind, str(night_dataset), NIGHT, tmp_path / form.value, wanted)
        ending = f".{kind.value}" if form == MessageForm.kvn else f".{kind.value}.xml"
        (file,) = (f for f in files if f.startswith(name))
        assert file.endswith(ending)
        message = reader.from_str((tmp_path / form.value / file).read_text())
        texts.append(re.sub(UNLIKE, "", message.to_str("kvn")))
    assert texts[0].split() == texts[1].split()
    assert len(texts[0].split()) > 30


def changed(dataset, folder, **tables):
    """A copy of the dataset in which some tables are what their functions return of them."""
    shutil.copytree(dataset, folder)
    for name, change in tables.items():
        (file,) = (folder / f"night={NIGHT}/{name}").iterdir()
        schema = pq.read_schema(file)
        rows = pl.DataFrame(pq.read_table(file, partitioning=None))
        pq.write_table(change(rows).to_arrow().cast(schema), file)
    return str(folder)


def test_orbits_are_messages_of_their_own_and_ephemerides_of_their_arcs(night_dataset, tmp_path):
    orbits = observed(night_dataset, "orbits").sort("object_id")
    opm = export(Message.opm, str(night_dataset), NIGHT, tmp_path / "opm")
    oem = export(Message.oem, str(night_dataset), NIGHT, tmp_path / "oem")
    assert len(opm) == len(oem) == len(orbits)
    row = orbits.row(0, named=True)
    data = ccsds.Opm.from_file(str(tmp_path / "opm" / opm[0])).segment.data
    state, covariance = data.state_vector, data.covariance_matrix
    assert [state.x, state.z_dot] == pytest.approx([row["x_km"], row["vz_km_s"]], abs=1e-9)
    assert covariance.cz_dot_x == pytest.approx(row["cov_xvz"], rel=1e-9)
    (segment,) = ccsds.Oem.from_file(str(tmp_path / "oem" / oem[0])).segments
    assert row["forces"] in list(segment.metadata.comment)
    assert len(segment.data.covariance_matrix) == len(segment.data.state_vector)


def test_an_object_without_an_orbit_is_exported_by_its_states(night_dataset, tmp_path):
    name = observed(night_dataset, "states")["object_id"].sort()[0]
    out = changed(
        night_dataset, tmp_path / "ds", orbits=lambda rows: rows.filter(pl.col("object_id") != name)
    )
    states = observed(night_dataset, "states").filter(object_id=name).sort("epoch")
    opm = export(Message.opm, out, NIGHT, tmp_path / "opm", Wanted([name]))
    oem = export(Message.oem, out, NIGHT, tmp_path / "oem", Wanted([name]))
    assert (len(opm), len(oem)) == (len(states), 1)
    state = ccsds.Opm.from_file(str(tmp_path / "opm" / opm[0])).segment.data.state_vector
    assert state.x == pytest.approx(states["x_km"][0], abs=1e-9)
    assert len(ccsds.Oem.from_file(str(tmp_path / "oem" / oem[0])).segments) == len(states)


def test_tracklets_without_object_are_in_the_message_of_their_sensor(night_dataset, tmp_path):
    rows = observed(night_dataset)
    lone = rows.drop_nulls("object_id")["tracklet_id"].drop_nulls().unique().sort()[:2].to_list()
    alone = pl.col("tracklet_id").is_in(lone)

    def without(rows):
        return rows.with_columns(object_id=pl.when(alone.not_()).then("object_id"))

    def named(rows):
        known = rows.head(1).with_columns(
            object_id=pl.lit(None, pl.String), tracklet_id=pl.lit(lone[0]), status=pl.lit("known"),
            norad_id=pl.lit(7, pl.Int64), name=pl.lit("SAT 7"),
        )  # fmt: skip
        return pl.concat([rows, known])

    out = changed(night_dataset, tmp_path / "ds", observations=without, identifications=named)
    sensors = set(rows.filter(alone)["sensor_id"])
    files = export(Message.tdm, out, NIGHT, tmp_path / "tdm")
    assert {f"{sensor}.tdm" for sensor in sensors} <= set(files)
    segments = [
        segment
        for sensor in sensors
        for segment in ccsds.Tdm.from_file(str(tmp_path / "tdm" / f"{sensor}.tdm")).segments
    ]
    assert sorted(s.metadata.participant_2 for s in segments) == lone
    comments = {s.metadata.participant_2: next(iter(s.metadata.comment)) for s in segments}
    assert comments[lone[0]] == f"ID {lone[0]}, NORAD 7, NAME SAT 7"
    assert comments[lone[1]].startswith("Astrometric directions")
    one = export(Message.tdm, out, NIGHT, tmp_path / "one", Wanted([lone[0]]))
    assert len([f for f in one if f.endswith(".tdm")]) == 1


def test_sensors_have_names_of_their_own_in_messages(night_dataset, tmp_path):
    first, second, *_ = sorted(set(observed(night_dataset)["sensor_id"]))

    def cyrillic(rows):
        names = {first: "\u0421\u0435\u0432\u0435\u0440", second: "\u0417\u0430\u043f\u0430\u0434"}
        return rows.with_columns(pl.col("sensor_id").replace(names))

    out = changed(night_dataset, tmp_path / "ds", observations=cyrillic, frames=cyrillic)
    files = written(Message.tdm, out, tmp_path / "tdm", Wanted())
    oem = {f.name: ccsds.Oem.from_file(str(f)).segments[0] for f in files if f.suffix == ".oem"}
    named = {file: of.metadata.object_name for file, of in oem.items()}
    assert {"_____.oem": "_____", "_____-2.oem": "_____-2"}.items() <= named.items()
    tdm = next(file for file in files if file.suffix == ".tdm")
    meta = [segment.metadata for segment in ccsds.Tdm.from_file(str(tdm)).segments]
    assert len(meta) > 2
    assert {each.participant_1 for each in meta} == set(named.values())
    assert all(named[each.ephemeris_name_1] == each.participant_1 for each in meta)


def test_one_object_can_be_asked_for(night_dataset, tmp_path):
    name = observed(night_dataset)["object_id"].drop_nulls()[0]
    files = export(Message.tdm, str(night_dataset), NIGHT, tmp_path / "a", Wanted([name]))
    assert [f for f in files if f.endswith("tdm")] == [f"{name}.tdm"]


def test_an_object_that_is_asked_for_twice_is_one_file(night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]
    files = export(Message.oem, str(night_dataset), NIGHT, tmp_path / "a", Wanted([name, name]))
    assert files == [f"{name}.oem"]


def test_a_folder_that_cannot_be_written_is_one_line(night_dataset, tmp_path, monkeypatch):
    def move(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("epipole.flows.export.shutil.move", move)
    with pytest.raises(DatasetError, match=r"out: cannot be made \(No space left on device\)"):
        export(Message.ades, str(night_dataset), NIGHT, tmp_path / "out")


def an_object_that_is_not_there(out):
    return {"wanted": Wanted(["20190401-99999"])}, "no observations of 20190401-99999"


def another_night(out):
    return {"night": "2019-04-02"}, "has no night 2019-04-02"


def a_folder_with_files(out):
    out.mkdir()
    (out / "notes.txt").touch()
    return {}, "is not empty"


def a_file(out):
    out.touch()
    return {}, "is a file"


@pytest.mark.parametrize(
    "prepare", [an_object_that_is_not_there, another_night, a_folder_with_files, a_file]
)
def test_bad_input_is_one_line_and_nothing_is_written(prepare, night_dataset, tmp_path):
    asked, says = prepare(tmp_path / "out")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match=says):
        export(
            **{"kind": Message.tdm, "dataset": str(night_dataset), "night": NIGHT,
               "out": tmp_path / "out"} | asked
        )  # fmt: skip
    assert sorted(tmp_path.rglob("*")) == before


def written(kind, dataset, folder, wanted):
    return [folder / name for name in export(kind, str(dataset), NIGHT, folder, wanted)]


@pytest.mark.parametrize("frame", ["EME2000", "ITRF"])
def test_an_ephemeris_is_what_screening_services_take(frame, night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]
    wanted = Wanted([name], MessageFrame(frame), ahead_h=3.0)
    (path,) = written(Message.oem, night_dataset, tmp_path / "oem", wanted)
    text = path.read_text()
    assert faults_of(text) == []
    assert "errors of the forces are not in the covariance" in text
    (segment,) = ccsds.Oem.from_str(text).segments
    first, last = (segment.data.state_vector[k].epoch for k in (0, -1))
    hours = (np.datetime64(last) - np.datetime64(first)) / np.timedelta64(1, "h")
    assert 3.0 < hours < 3.1


@pytest.mark.parametrize("kind", [Message.oem, Message.opm, Message.ocm])
def test_a_message_says_what_is_known_against_its_object(kind, night_dataset, tmp_path):
    sound, moved, *_ = observed(night_dataset, "orbits")["object_id"].sort()

    def judged(rows):
        is_it = pl.col("object_id") == moved
        return rows.with_columns(verdict=pl.when(is_it).then(pl.lit("manoeuvred"))
                                 .otherwise(pl.lit("sound")))  # fmt: skip

    out = changed(night_dataset, tmp_path / "ds", objects=judged)
    (with_doubt, without) = (
        written(kind, out, tmp_path / name, Wanted([name]))[0].read_text()
        for name in (moved, sound)
    )
    assert "COMMENT Verdict manoeuvred: It changed its orbit" in with_doubt
    assert "Verdict" not in without
    assert max(map(len, with_doubt.splitlines()[:30])) <= 254


def test_an_ephemeris_says_that_the_object_comes_down(night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]
    r_km = 6378.0 + 150.0
    low = {"x_km": r_km, "y_km": 0.0, "z_km": 0.0, "vx_km_s": 0.0, "vy_km_s": 4.0,
           "vz_km_s": (398600.4418 / r_km - 16.0) ** 0.5,
           "forces": "GM J2-J4 C22 Sun Moon drag 0.1000 m2/kg"}  # fmt: skip

    def falling(rows):
        return rows.with_columns(**{k: pl.lit(v).cast(rows.schema[k]) for k, v in low.items()})

    out = changed(night_dataset, tmp_path / "ds", orbits=falling)
    wanted = Wanted([name], MessageFrame.EME2000, ahead_h=24.0)
    (path,) = written(Message.oem, out, tmp_path / "oem", wanted)
    assert "The object comes down: its ephemeris ends there." in path.read_text()
    (segment,) = ccsds.Oem.from_file(str(path)).segments
    assert abs(segment.data.state_vector[-1].x) < 7e3


def test_the_checker_of_screening_finds_what_is_wrong(night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]
    (path,) = written(Message.oem, night_dataset, tmp_path / "oem", Wanted([name]))
    text = path.read_text()
    assert faults_of(text) == ["frame", "frame of covariance"]  # GCRF
    assert "a state without covariance" in faults_of(text[: text.index("COVARIANCE_START")])
    lines = text.splitlines(keepends=True)
    (start,) = (k for k, line in enumerate(lines) if line.startswith("META_STOP"))
    assert "a state without covariance" in faults_of(
        "".join(lines[: start + 2] + lines[start + 3 :])
    )


def test_frames_of_messages_hold_the_same_states(night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]
    vectors = {}
    for frame in MessageFrame:
        folder = tmp_path / frame
        (path,) = written(Message.opm, night_dataset, folder, Wanted([name], frame))
        vectors[frame] = ccsds.Opm.from_file(str(path)).segment.data
    states = {frame: data.state_vector for frame, data in vectors.items()}
    r, v = (
        {f: np.array([[getattr(s, a + end) for a in "xyz"]]) for f, s in states.items()}
        for end in ("", "_dot")
    )
    time_ns = np.array([np.datetime64(states["GCRF"].epoch, "ns").astype(np.int64)])
    orientation = orientation_at(time_ns, *read_earth_orientation())
    for frame in ("EME2000", "ITRF"):
        back_r, back_v = to_gcrf(frame, time_ns, r[frame], v[frame], orientation)
        assert np.abs(back_r - r["GCRF"]).max() < 3e-6  # times have microseconds
        assert np.abs(back_v - v["GCRF"]).max() < 1e-8
    total = [
        sum(getattr(data.covariance_matrix, f"c{a}_{a}") for a in "xyz")
        for data in vectors.values()
    ]
    assert total == pytest.approx([total[0]] * 3, rel=1e-9)


def test_a_comprehensive_message_has_the_numbers_of_the_catalogue(night_dataset, tmp_path):
    name = observed(night_dataset, "orbits")["object_id"][0]

    def named(rows):
        is_it = pl.col("object_id") == name
        return rows.with_columns(
            status=pl.when(is_it).then(pl.lit("known")).otherwise("status"),
            norad_id=pl.when(is_it).then(pl.lit(7, pl.Int64)),
            cospar_id=pl.when(is_it).then(pl.lit("1998-067A")),
            name=pl.when(is_it).then(pl.lit("S")),
        )  # fmt: skip

    out = changed(night_dataset, tmp_path / "ds", identifications=named)
    wanted = Wanted([name], MessageFrame.EME2000)
    (path,) = written(Message.ocm, out, tmp_path / "ocm", wanted)
    message = ccsds.Ocm.from_file(str(path)).segment
    meta, (trajectory,), (covariance,) = message.metadata, message.data.traj, message.data.cov
    assert (meta.object_name, meta.international_designator) == ("S", "1998-067A")
    assert (meta.catalog_name, meta.object_designator) == ("SATCAT", "7")
    assert (trajectory.traj_ref_frame, trajectory.traj_type) == ("EME2000", "CARTPV")
    assert len(trajectory.traj_lines) == len(covariance.cov_lines) > 6
    (other,) = written(Message.oem, out, tmp_path / "oem", wanted)
    (segment,) = ccsds.Oem.from_file(str(other)).segments
    first = segment.data.state_vector[0]
    assert list(trajectory.traj_lines[0].values) == pytest.approx(
        [first.x, first.y, first.z, first.x_dot, first.y_dot, first.z_dot]
    )
