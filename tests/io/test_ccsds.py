"""Messages: read back by their library they say what was written, with the units that are meant."""

import ccsds_ndm as ccsds
import numpy as np
import pytest

from epipole.io.ccsds import (
    Directions,
    Ephemeris,
    Subject,
    ephemeris_message,
    safe_name,
    state_message,
    times,
    tracking_data,
)

T0 = 1_554_091_200_187_546_615
STATE = np.array([-39569.338592123, 14561.8, 273.9, -1.061374123, -2.88, 8.6e-4])
A = np.random.default_rng(1).normal(size=(6, 6)) * np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])
COV = A.T @ A


def ephemeris(n=3):
    time_ns = T0 + np.arange(n) * 60_000_000_000
    return Ephemeris(time_ns, np.tile(STATE, (n, 1)), time_ns[:1], COV[None])


def test_times_have_microseconds():
    at = times(np.array([T0, T0 - 116, 1_554_163_199_999_999_600]))
    assert at[:2] == ["2019-04-01T04:00:00.187547", "2019-04-01T04:00:00.187546"]
    assert at[2] == "2019-04-02T00:00:00.000000"  # rounded, not cut


@pytest.mark.parametrize(
    ("text", "expected"),
    [("sat1", "sat1"), ("a b\n", "a_b_"), ("../x", ".._x"), ("é", "_"), ("", "_")],
)
def test_names_have_nothing_that_a_reader_or_a_folder_could_take_for_more(text, expected):
    assert safe_name(text) == expected


def test_an_ephemeris_has_its_states_and_covariances():
    read = ccsds.Oem.from_str(ephemeris_message(Subject("sat 1"), [ephemeris()], ["from its log"]))
    (segment,) = read.segments
    meta = segment.metadata
    assert (meta.object_name, meta.center_name, meta.ref_frame) == ("sat_1", "EARTH", "GCRF")
    assert (meta.time_system, meta.interpolation_degree) == ("UTC", 2)
    vectors = segment.data.state_vector
    assert [v.epoch for v in vectors] == times(ephemeris().time_ns)
    assert [vectors[0].x, vectors[0].z_dot] == pytest.approx([STATE[0], STATE[5]], abs=1e-9)
    (covariance,) = segment.data.covariance_matrix
    assert covariance.cov_ref_frame == "GCRF"
    found = [covariance.cx_x, covariance.cy_x, covariance.cz_dot_z_dot]
    assert found == pytest.approx([COV[0, 0], COV[1, 0], COV[5, 5]])


def test_a_state_has_its_covariance_by_name():
    text = state_message(Subject("20190401-00001"), ephemeris(1), ["fitted"])
    values = dict(line.split("=") for line in text.splitlines() if "=" in line)
    values = {key.strip(): value.strip() for key, value in values.items()}
    axes = ["X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"]
    assert [float(values[a]) for a in axes] == pytest.approx(STATE, abs=1e-9)
    for i, a in enumerate(axes):
        for j, b in enumerate(axes[: i + 1]):
            assert float(values[f"C{a}_{b}"]) == pytest.approx(COV[i, j], rel=1e-9), (a, b)
    assert "COV_REF_FRAME" not in values  # it is that of the state
    assert "MESSAGE_ID" not in values


NAMED = Subject("20190401-00001", 25544, "1998-067A", "ISS (ZARYA)")


def test_an_object_with_a_name_has_it_and_its_numbers():
    oem = ccsds.Oem.from_str(ephemeris_message(NAMED, [ephemeris()], ["fitted"])).segments[0]
    opm = ccsds.Opm.from_str(state_message(NAMED, ephemeris(1), ["fitted"])).segment
    for meta in (oem.metadata, opm.metadata):
        assert (meta.object_name, meta.object_id) == ("ISS__ZARYA_", "1998-067A")
        says = "ID 20190401-00001, NORAD 25544, COSPAR 1998-067A, NAME ISS (ZARYA)"
        assert list(meta.comment) == [says, "fitted"]
    time_ns = T0 + np.arange(1)
    seen = Directions(time_ns, np.zeros(1), np.zeros(1), np.zeros(1), 0.0, "s.oem", ["seen"])
    (segment,) = ccsds.Tdm.from_str(tracking_data([(NAMED, "s", seen)])).segments
    assert segment.metadata.participant_2 == "20190401-00001"
    assert list(segment.metadata.comment) == [says, "seen"]


def test_a_name_stays_one_line_of_ascii():
    odd = Subject("o", name="é\nX = 1")
    assert odd.comments() == ["ID o, NAME ?\\nX = 1"]
    assert Subject("o", cospar_id="2020-001A").comments() == ["ID o, COSPAR 2020-001A"]
    assert Subject("o").comments() == []


def test_a_long_name_fits_in_the_lines_that_readers_take():
    long = Subject("o" * 300, 7, "2020-001A" * 50, "N" * 500)
    for text in (
        ephemeris_message(long, [ephemeris()], ["fitted"]),
        state_message(long, ephemeris(1), ["fitted"]),
    ):
        assert max(map(len, text.splitlines())) <= 254
    assert len(safe_name("s" * 400)) < 250


def test_tracking_data_have_a_segment_per_sensor():
    time_ns = T0 + np.arange(2) * 1_000_000_000
    seen = Directions(
        time_ns, np.array([0.1234567891, 359.9]), np.array([-5.0, 1.6e-9]),
        np.array([8.25, np.nan]), 0.0007, "sat1.oem", ["as told"],
    )  # fmt: skip
    of = Subject("20190401-00001")
    text = tracking_data([(of, "sat1", seen), (of, "sat2", seen)])
    read = ccsds.Tdm.from_str(text)
    assert [s.metadata.participant_1 for s in read.segments] == ["sat1", "sat2"]
    meta = read.segments[0].metadata
    assert (meta.participant_2, meta.path, meta.timetag_ref) == ("20190401-00001", "2,1", "RECEIVE")
    assert (meta.angle_type, meta.reference_frame) == ("RADEC", "EME2000")
    assert meta.ephemeris_name_1 == "sat1.oem"
    rows = [(o.epoch, o.keyword, o.value) for o in read.segments[0].data.observations]
    first, second = times(time_ns)
    assert rows == [
        (first, "ANGLE_1", 0.123456789), (first, "ANGLE_2", -5.0), (first, "MAG", 8.25),
        (second, "ANGLE_1", 359.9), (second, "ANGLE_2", pytest.approx(2e-9)),
    ]  # fmt: skip
    assert text.isascii()
    assert "e-" not in text.split("DATA_START")[1]
