"""A short night of real satellites, from the simulator through the pipeline to its evaluation."""

import pytest

from epipole.flows.evaluate import evaluate
from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate

pytestmark = pytest.mark.usefixtures("prefect")


@pytest.mark.long
def test_co_located_satellites_are_told_apart_with_honest_covariances(tmp_path):
    made = simulate("real_geo", tmp_path / "n.mcap", hours=0.03)
    nightly([str(made.logs[0])], str(tmp_path / "out"))
    report = evaluate(tmp_path / "out", made.truth)
    assert report.frames == made.frames == 162
    assert report.frames_solved == 1.0
    assert report.att_wrong == report.ghosts == report.id_swaps == report.objects_lost == 0
    assert report.objects_seen_by_two >= 17
    assert report.object_recall > 0.99
    assert report.pair_precision > 0.999
    # 18 objects share six drawn biases: a standard error of some 0.2, and 5 of these.
    assert 0.3 < report.nees_mean < 2.0
    assert report.nees_in_99 > 0.9
    assert report.pos_err_km_median < 3.0
