"""Link tracklets: the task gives ids to what the orbits join, and merges objects only in turn."""

from collections.abc import Sequence

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.orbit_tracklets import NIGHT, START_NS, orbit_tracklets, rows_of

from epipole.schemas.bridge import array
from epipole.schemas.settings import LinkingSettings
from epipole.schemas.tables import TRACKLETS
from epipole.tasks.name.link_tracklets import OrbitLinks, link_tracklets


@pytest.fixture(scope="module")
def scene():
    return orbit_tracklets(11, 6, 4, 60.0)


def linked(
    rows: pa.Table,
    settings: LinkingSettings = LinkingSettings(),  # noqa: B008
    taken: Sequence[str] = (),
) -> OrbitLinks:
    names = [*filter(None, rows["object_id"].unique().to_pylist()), *taken]
    return link_tracklets.fn(rows, NIGHT, names, settings)


def ids(links: OrbitLinks) -> dict[str, str]:
    return dict(zip(*(links.tracklets[name].to_pylist() for name in ("tracklet_id", "object_id")),
                    strict=True))  # fmt: skip


def test_objects_get_numbers_in_order_of_first_appearance(scene):
    links = linked(rows_of(scene))
    found = ids(links)
    assert len(found) == 24
    first = list(dict.fromkeys(found[f"t{k:02d}"] for k in range(24)))
    assert first == [f"20260530-{k:05d}" for k in range(1, 7)]
    for number in range(6):
        assert len({found[f"t{k:02d}"] for k in np.flatnonzero(scene.object == number)}) == 1
    assert sorted(links.orbits["object_id"].to_pylist()) == first
    assert np.isfinite(array(links.orbits, "x_km")).all()


def test_the_order_of_the_rows_does_not_matter(scene):
    rows = rows_of(scene)
    turned = rows.take(np.arange(24)[::-1])
    assert ids(linked(rows)) == ids(linked(turned))


def test_tracklets_join_the_object_that_is_there(scene):
    of_two = np.flatnonzero(scene.object == 2)
    named = [None] * 24
    named[of_two[0]] = named[of_two[1]] = "20260530-00007"
    outcome = ["object" if name else "seen_by_one" for name in named]
    links = linked(rows_of(scene, object_id=named, outcome=outcome))
    found = ids(links)
    assert {found[f"t{k:02d}"] for k in of_two[2:]} == {"20260530-00007"}
    assert min(set(found.values()) - {"20260530-00007"}) == "20260530-00008"
    assert "20260530-00007" not in links.orbits["object_id"].to_pylist()  # it has positions
    assert not links.renamed


def test_an_object_that_is_seen_again_has_its_earlier_id(scene):
    a, b, c, d = np.flatnonzero(scene.object == 4)
    named = [None] * 24
    named[a] = named[b] = "20260530-00001"
    named[c] = named[d] = "20260530-00002"
    outcome = ["object" if name else "seen_by_one" for name in named]
    links = linked(rows_of(scene, object_id=named, outcome=outcome))
    assert links.renamed == {"20260530-00002": "20260530-00001"}
    # Also in between.
    named[b], named[c] = named[c], named[b]
    rows = rows_of(scene, object_id=named, outcome=outcome)
    assert linked(rows).renamed == links.renamed
    # At the same time they stay two: an object has one position per epoch.
    end = array(rows, "end_time").copy()
    end[a] = array(rows, "start_time")[b]
    together = rows_of(scene, object_id=named, outcome=outcome, end_time=end)
    assert linked(together).tracklets.num_rows
    assert not linked(together).renamed


def test_a_new_object_has_no_id_of_one_without_tracklets(scene):
    found = ids(linked(rows_of(scene), taken=["20260530-00041", "20260529-00099"]))
    assert min(found.values()) == "20260530-00042"


@pytest.mark.parametrize("outcome", ["ambiguous", "undecided", "seen_by_one", "not_compared"])
def test_tracklets_without_an_object_are_linked(scene, outcome):
    links = linked(rows_of(scene, outcome=[outcome] * 24))
    assert links.tracklets.equals(linked(rows_of(scene)).tracklets)
    assert links.tracklets.num_rows


@pytest.mark.parametrize("outcome", ["disagrees", "sensor_left_out"])
def test_tracklets_of_other_outcomes_stay_as_they_are(scene, outcome):
    links = linked(rows_of(scene, outcome=[outcome] * 24))
    assert links.tracklets.num_rows == 0


def test_tracklets_without_an_attributable_stay_as_they_are(scene):
    rows = pl.DataFrame(rows_of(scene)).with_columns(
        ra_deg=pl.when(pl.col("tracklet_id") != "t00").then("ra_deg"),
        epoch=pl.when(pl.col("tracklet_id") != "t00").then("epoch"),
    )
    found = ids(linked(rows.to_arrow().cast(TRACKLETS)))
    assert "t00" not in found
    assert len(found) == 23


def test_an_object_outside_the_night_gets_no_id(scene):
    day = 86_400_000_000_000
    later = scene.tracklets.time_s * 1e9 + START_NS + day
    rows = rows_of(scene, epoch=later.astype(np.int64))
    assert linked(rows).tracklets.num_rows == 0


def test_linking_can_be_switched_off_and_needs_tracklets(scene):
    assert linked(rows_of(scene), LinkingSettings(enabled=False)).tracklets.num_rows == 0
    assert linked(TRACKLETS.empty_table()).tracklets.num_rows == 0
