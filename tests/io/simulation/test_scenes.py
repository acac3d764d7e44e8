"""Scene files."""

import csv
import json
import re

import numpy as np
import pytest
from scenes.satellites import ISS, LINES, two_lines
from sgp4.api import Satrec
from sgp4.exporter import export_omm

from epipole.io.simulation.scenes import (
    built_in_element_files,
    built_in_scenes,
    read_element_sets,
    read_scene,
)
from epipole.schemas.errors import SceneError


def test_an_unknown_scene_is_an_error_that_lists_the_built_in_scenes(tmp_path):
    with pytest.raises(SceneError, match=r"the built-in scenes are .*night"):
        read_scene(tmp_path / "none.toml")


def test_a_scene_file_is_read_with_what_all_sensors_share(tmp_path):
    text = """
    name = "mine"
    [sensor_defaults]
    camera = { fov_deg = 9.0, k1 = -0.1 }
    pointing = { mode = "random" }
    [[sensors]]
    id = "a"
    orbit = { a_km = 7000.0 }
    [[sensors]]
    id = "b"
    orbit = { a_km = 7000.0 }
    camera = { k1 = 0.1 }
    """
    (tmp_path / "mine.toml").write_text(text)
    cameras = [sensor.camera for sensor in read_scene(tmp_path / "mine.toml").sensors]
    assert [(c.fov_deg, c.k1) for c in cameras] == [(9.0, -0.1), (9.0, 0.1)]


def write(path, text):
    path.write_text(text)
    return path


def omm_fields():
    return export_omm(Satrec.twoline2rv(*LINES), "ISS (ZARYA)")


def as_xml(fields):
    metadata = ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM",
                "MEAN_ELEMENT_THEORY")  # fmt: skip
    mean = ("EPOCH", "MEAN_MOTION", "ECCENTRICITY", "INCLINATION", "RA_OF_ASC_NODE",
            "ARG_OF_PERICENTER", "MEAN_ANOMALY")  # fmt: skip
    rest = [key for key in fields if key not in metadata + mean]

    def tags(names):
        return "".join(f"<{name}>{fields[name]}</{name}>" for name in names)

    return (
        '<?xml version="1.0"?><ndm><omm><body><segment>'
        f"<metadata>{tags(metadata)}</metadata><data>"
        f"<meanElements>{tags(mean)}</meanElements><tleParameters>{tags(rest)}</tleParameters>"
        "</data></segment></body></omm></ndm>"
    )


def as_csv(fields, path):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(fields))
        writer.writeheader()
        writer.writerow(fields)
    return path


@pytest.mark.parametrize("head", ["", "ISS (ZARYA)\n", "0 ISS (ZARYA)   \n", "# a comment\n\n"])
def test_two_line_elements_are_read_with_and_without_names(head, tmp_path):
    text = head + "\n".join(LINES) + "\n" + "\n".join(two_lines("2", 13.0)) + "\n"
    first, second = read_element_sets(write(tmp_path / "a.tle", text))
    assert (first.name, first.number) == ("ISS (ZARYA)" if "ISS" in head else "", 25544)
    assert (second.name, second.number) == ("", 2)
    assert first.elements == pytest.approx(ISS.elements, rel=1e-14)
    assert str(np.datetime64(first.epoch_ns, "ns")).startswith("2026-05-30T12:25:10.468992")


@pytest.mark.parametrize("form", ["json", "one", "csv", "xml"])
def test_an_omm_says_what_the_two_lines_say(form, tmp_path):
    path, fields = tmp_path / "a.file", omm_fields()
    if form == "csv":
        as_csv(fields, path)
    else:
        texts = {"json": json.dumps([fields]), "one": json.dumps(fields), "xml": as_xml(fields)}
        write(path, texts[form])
    (found,) = read_element_sets(path)
    assert (found.name, found.number) == ("ISS (ZARYA)", 25544)
    # The epoch of an OMM is rounded to microseconds: 8 mm of a low orbit.
    assert abs(found.epoch_ns - ISS.epoch_ns) <= 1000
    assert found.elements == pytest.approx(ISS.elements, rel=1e-12)


def test_what_an_orbit_does_not_need_may_be_missing_in_an_omm(tmp_path):
    fields = {k: v for k, v in omm_fields().items()
              if k not in ("REV_AT_EPOCH", "ELEMENT_SET_NO", "OBJECT_ID")}  # fmt: skip
    (found,) = read_element_sets(write(tmp_path / "a.json", json.dumps(fields)))
    assert found.elements == pytest.approx(ISS.elements, rel=1e-12)


def test_an_omm_has_numbers_that_two_lines_cannot_hold(tmp_path):
    text = json.dumps([omm_fields() | {"NORAD_CAT_ID": 270000001}])
    (found,) = read_element_sets(write(tmp_path / "a.json", text))
    assert found.number == 270000001
    assert found.elements == pytest.approx(ISS.elements, rel=1e-12)


def changed(line, at, to):
    return line[:at] + to + line[at + 1 :]


BAD = {
    "line 1: its checksum is 8, expected 5": "\n".join([changed(LINES[0], 30, "9"), LINES[1]]),
    "line 2: expected line 2 of the elements": "\n".join([LINES[0], LINES[0]]),
    "line 1: line 2 of the elements without": LINES[1],
    "ends after line 1 of an element set": LINES[0],
    "has no element sets": "# nothing\n",
    "message 1: not an OMM: MEAN_MOTION is missing": json.dumps(
        {k: v for k, v in omm_fields().items() if k != "MEAN_MOTION"}
    ),
    "message 1: not an OMM: MEAN_ELEMENT_THEORY is DSST": json.dumps(
        omm_fields() | {"MEAN_ELEMENT_THEORY": "DSST"}
    ),
    "not JSON": "[1,",
    "not an OMM in XML": "<ndm>",
}


@pytest.mark.parametrize("says", BAD)
def test_a_bad_file_is_one_line_that_names_the_place(says, tmp_path):
    with pytest.raises(SceneError, match=r"a\.tle.*" + re.escape(says)):
        read_element_sets(write(tmp_path / "a.tle", BAD[says]))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"none\.tle: cannot be read as element sets"):
        read_element_sets(tmp_path / "none.tle")


def test_the_package_has_the_satellites_of_its_scenes():
    names = {file: [s.name for s in read_element_sets(file)] for file in built_in_element_files()}
    assert sorted(names) == ["real_geo.tle", "real_leo.tle", "real_sensors.tle"]
    assert all(20 > len(n) > 10 or len(n) == 30 for n in names.values())
    for scene in map(read_scene, built_in_scenes()):
        for group in [*scene.sensors, *scene.targets]:
            if group.orbit.elements:
                assert set(group.orbit.satellites) <= set(names[group.orbit.elements])


def test_element_files_lie_beside_the_scene_that_names_them(tmp_path, monkeypatch):
    write(tmp_path / "mine.tle", "\n".join(LINES))
    text = """
    name = "mine"
    [[sensors]]
    id = "a"
    orbit = { elements = "mine.tle" }
    camera = { fov_deg = 9.0 }
    pointing = { mode = "body" }
    """
    scene = read_scene(write(tmp_path / "mine.toml", text))
    monkeypatch.chdir("/")
    assert read_element_sets(scene.sensors[0].orbit.elements)[0].number == 25544
