"""The catalogue of known objects: bad records are told and skipped, an empty file is refused."""

import hashlib
import json

import pytest
from scenes.satellites import LINES, two_lines
from sgp4.api import Satrec
from sgp4.exporter import export_omm
from sgp4.io import compute_checksum

from epipole.io.catalogues.element_sets import read_known_objects
from epipole.schemas.errors import CatalogueError

GOOD = "\n".join(["ISS (ZARYA)", *LINES])


def write(path, text):
    path.write_text(text)
    return str(path)


def test_a_catalogue_has_its_sets_and_the_digest_of_its_bytes(tmp_path):
    where = write(tmp_path / "a.tle", GOOD)
    known = read_known_objects(where)
    (found,) = known.sets
    assert (found.name, found.number, found.cospar_id) == ("ISS (ZARYA)", 25544, "1998-067A")
    assert known.faults == []
    assert known.sha256 == hashlib.sha256(GOOD.encode()).hexdigest()


def of_type(number):
    """Return line 1 of the space station with another ephemeris type."""
    line = f"{LINES[0][:62]}{number}{LINES[0][63:68]}"
    return f"{line}{compute_checksum(line)}"


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace("\n", "\n "),
        "\n".join(f"\t {line}" for line in GOOD.splitlines()),
        f"1 SAT\n{GOOD}",
        f"2 2019 a\n{GOOD}",
        f"ISS (ZARYA)\n{of_type(0)}\n{LINES[1]}",
        f"ISS (ZARYA)\n{of_type(2)}\n{LINES[1]}",
    ],
)
def test_lines_may_be_indented_and_names_begin_with_a_number(text, tmp_path):
    known = read_known_objects(write(tmp_path / "a.tle", text))
    assert [(each.name, each.number) for each in known.sets] == [("ISS (ZARYA)", 25544)]
    assert known.faults == []


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (LINES[0] + "\n" + GOOD, "expected line 2"),
        (GOOD + "\n" + LINES[1], "line 2 of the elements without line 1"),
        (GOOD + "\n" + LINES[0][:-1] + "9\n" + LINES[1], "its checksum is 9"),
        (GOOD + "\n" + LINES[0] + "\n" + two_lines("2", 13.0)[1], "line 1 is of 25544"),
        (GOOD + "\n" + LINES[0], "ends after line 1"),
        (GOOD + f"\nX\n{LINES[0][:60]}\n{LINES[1][:60]}", "line 5: 60 characters; elements have"),
        (GOOD + f"\nX\n{LINES[0][:7]}\n{LINES[1][:7]}", "line 5: 7 characters"),
        (GOOD + f"\nX\n{LINES[0]}\n{LINES[1][:7]}", "line 6: 7 characters"),
        (GOOD + "\n" + LINES[1][:60], "line 2 of the elements without line 1"),
        (GOOD + f"\n{LINES[0].replace('11776', '1177²')}\n{LINES[1]}", "line 4: has other char"),
        (GOOD + f"\n{LINES[0]}\n{LINES[1][:68]}²", "line 5: has other characters"),
        (GOOD + f"\n{of_type(4)}\n{LINES[1]}", "line 4: its ephemeris type is 4 (SGP4-XP), exp"),
    ],
)
def test_one_bad_record_is_told_and_the_others_are_read(text, what, tmp_path):
    known = read_known_objects(write(tmp_path / "a.tle", text))
    assert [each.number for each in known.sets] == [25544]
    (fault,) = known.faults
    assert what in str(fault)
    assert str(fault).startswith("line ")


def omm(**changed):
    return export_omm(Satrec.twoline2rv(*LINES), "ISS (ZARYA)") | changed


@pytest.mark.parametrize(
    "bad",
    [
        {"MEAN_MOTION": "fast"}, {"MEAN_MOTION": "0"}, {"MEAN_MOTION": "nan"},
        {"ECCENTRICITY": 1.5}, {"EPOCH": "yesterday"}, {"NORAD_CAT_ID": None},
        {"MEAN_ELEMENT_THEORY": "DSST"}, {"MEAN_MOTION": "9" * 400},
        {"MEAN_ELEMENT_THEORY": "SGP4-XP"}, {"EPHEMERIS_TYPE": 4},
    ],
)  # fmt: skip
def test_one_bad_message_is_told_and_the_others_are_read(bad, tmp_path):
    text = json.dumps([omm(**bad), omm(), 5])
    known = read_known_objects(write(tmp_path / "a.json", text))
    assert [each.number for each in known.sets] == [25544]
    assert [fault.where for fault in known.faults] == ["message 1", "message 3"]


@pytest.mark.parametrize("theory", ["SGP4", "SGP", "SGP/SGP4"])
def test_elements_for_sgp4_are_read(theory, tmp_path):
    text = json.dumps([omm(MEAN_ELEMENT_THEORY=theory)])
    assert len(read_known_objects(write(tmp_path / "a.json", text)).sets) == 1


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"TIME_SYSTEM": "TAI"}, "TIME_SYSTEM is TAI, expected UTC"),
        ({"CENTER_NAME": "MARS"}, "CENTER_NAME is MARS, expected EARTH"),
        ({"REF_FRAME": "EME2000"}, "REF_FRAME is EME2000, expected TEME"),
    ],
)
def test_elements_at_other_times_or_in_other_frames_are_told(changed, what, tmp_path):
    known = read_known_objects(write(tmp_path / "a.json", json.dumps([omm(), omm(**changed)])))
    assert [str(fault) for fault in known.faults] == [f"message 2: not an OMM: {what}"]
    assert len(known.sets) == 1


@pytest.mark.parametrize(
    "given", [{"TIME_SYSTEM": "utc"}, {"CENTER_NAME": "Earth"}, {"REF_FRAME": ""}]
)
def test_what_elements_for_sgp4_have_may_be_in_any_case_or_missing(given, tmp_path):
    assert len(read_known_objects(write(tmp_path / "a.json", json.dumps([omm(**given)]))).sets) == 1


def segment(left_out=None):
    """Return a segment of an OMM in XML, without one of its parts."""
    fields = omm()
    parts = {
        "metadata": ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "MEAN_ELEMENT_THEORY"),
        "meanElements": (
            "EPOCH", "MEAN_MOTION", "ECCENTRICITY", "INCLINATION", "RA_OF_ASC_NODE",
            "ARG_OF_PERICENTER", "MEAN_ANOMALY",
        ),
        "tleParameters": ("NORAD_CAT_ID", "BSTAR", "MEAN_MOTION_DOT", "MEAN_MOTION_DDOT"),
    }  # fmt: skip
    metadata, elements, parameters = (
        "" if part == left_out
        else f"<{part}>{''.join(f'<{n}>{fields[n]}</{n}>' for n in names)}</{part}>"
        for part, names in parts.items()
    )  # fmt: skip
    return f"<segment>{metadata}<data>{elements}{parameters}</data></segment>"


@pytest.mark.parametrize(
    ("left_out", "what"),
    [
        ("tleParameters", "message 2: not an OMM: NORAD_CAT_ID is missing"),
        ("meanElements", "message 2: not an OMM: EPOCH is missing"),
        ("data", "message 2: not an OMM: NORAD_CAT_ID is missing"),
    ],
)
def test_one_bad_segment_is_told_and_the_others_are_read(left_out, what, tmp_path):
    bad = "<segment/>" if left_out == "data" else segment(left_out)
    text = f"<ndm><omm><body>{segment()}{bad}</body></omm><omm>{segment('metadata')}</omm></ndm>"
    known = read_known_objects(write(tmp_path / "a.xml", text))
    assert [(s.name, s.number) for s in known.sets] == [("ISS (ZARYA)", 25544), ("", 25544)]
    assert [str(fault) for fault in known.faults] == [what]


def test_what_the_orbit_does_not_need_may_be_anything(tmp_path):
    odd = omm(
        CLASSIFICATION_TYPE="", REV_AT_EPOCH="many", EPHEMERIS_TYPE="\u00e9", OBJECT_ID="\ud55c"
    )
    known = read_known_objects(write(tmp_path / "a.json", json.dumps([odd])))
    assert [(each.number, each.cospar_id) for each in known.sets] == [(25544, "\ud55c")]


def test_a_letter_that_is_no_text_costs_nothing_but_itself(tmp_path):
    (tmp_path / "a.tle").write_bytes(GOOD.encode().replace(b"ZARYA", b"Z\xffRYA"))
    (found,) = read_known_objects(str(tmp_path / "a.tle")).sets
    assert found.name == "ISS (Z\N{REPLACEMENT CHARACTER}RYA)"


def test_an_epoch_may_have_any_number_of_decimals(tmp_path):
    whole = omm()["EPOCH"].partition(".")[0]
    ends = ("", "Z", ".1", ".123456", ".1234567", ".123456789Z")
    text = json.dumps([*(omm(EPOCH=whole + end) for end in ends), omm(EPOCH=f"{whole}.5+02:00")])
    known = read_known_objects(write(tmp_path / "a.json", text))
    first_ns, *others_ns = (each.epoch_ns for each in known.sets)
    since_ms = [round((at_ns - first_ns) / 1e6, 3) for at_ns in others_ns]
    assert since_ms == [0.0, 100.0, 123.456, 123.456, 123.456]
    assert [fault.where for fault in known.faults] == ["message 7"]


def test_numbers_may_have_more_than_five_digits(tmp_path):
    text = json.dumps([omm(NORAD_CAT_ID=123456), omm(NORAD_CAT_ID="987654321")])
    known = read_known_objects(write(tmp_path / "a.json", text))
    assert [each.number for each in known.sets] == [123456, 987654321]


def test_what_no_table_can_hold_is_an_invalid_record(tmp_path):
    # Times of tables end in 2262, and numbers of satellites have nine digits.
    odd = [omm(EPOCH="9999-12-31T00:00:00"), omm(EPOCH="0001-01-01T00:00:00")]
    odd += [omm(NORAD_CAT_ID=10**9), omm(NORAD_CAT_ID="-5"), omm(NORAD_CAT_ID="9" * 40)]
    known = read_known_objects(write(tmp_path / "a.json", json.dumps([*odd, omm()])))
    assert [each.number for each in known.sets] == [25544]
    assert [fault.where for fault in known.faults] == [f"message {k}" for k in range(1, 6)]
    assert "epoch is out of bounds" in str(known.faults[0])
    assert "nine digits at most" in str(known.faults[2])


def test_a_table_may_have_comments_and_spaces_after_commas(tmp_path):
    fields = omm()
    rows = ["# from a web page", "", ", ".join(fields), ", ".join(map(str, fields.values()))]
    known = read_known_objects(write(tmp_path / "a.csv", "\n".join(rows)))
    assert ([each.number for each in known.sets], known.faults) == ([25544], [])


def test_a_catalogue_of_two_forms_has_those_of_the_first(tmp_path):
    table = omm()
    text = ",".join(table) + "\n" + ",".join(str(v) for v in table.values()) + "\n" + GOOD
    known = read_known_objects(write(tmp_path / "a.csv", text))
    assert [each.number for each in known.sets] == [25544]
    assert len(known.faults) == 3


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "has no element sets; give"),
        ("a\nb\n", "has no element sets; give"),
        ("[]", "has no element sets; give"),
        ("[" * 100_000, "not JSON"),
        ("{", "not JSON"),
        ("<a>", "not an OMM in XML"),
        (LINES[0], r"has no element sets \(line 1: the file ends after line 1"),
    ],
)
def test_a_file_without_element_sets_is_refused_in_one_line(text, what, tmp_path):
    with pytest.raises(CatalogueError, match=what) as caught:
        read_known_objects(write(tmp_path / "a.file", text))
    assert "\n" not in str(caught.value)
    assert "OMM in CSV, JSON or XML" in str(caught.value)


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(CatalogueError, match="no such file"):
        read_known_objects(str(tmp_path / "none.tle"))
    with pytest.raises(CatalogueError, match="not a regular file"):
        read_known_objects(str(tmp_path))
    (tmp_path / "a.bin").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(CatalogueError, match="has no element sets"):
        read_known_objects(str(tmp_path / "a.bin"))


def test_a_catalogue_behind_a_url_is_read(tmp_path):
    import fsspec

    with fsspec.open("memory://catalogue.tle", "w") as file:
        file.write(GOOD)
    assert [each.number for each in read_known_objects("memory://catalogue.tle").sets] == [25544]
    with pytest.raises(CatalogueError, match="no such file"):
        read_known_objects("memory://none.tle")
