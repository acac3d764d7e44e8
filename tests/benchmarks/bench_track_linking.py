"""Broken tracks: IDF1 and time of both methods, beside Stone Soup and laptrack where installed.

    python tests/benchmarks/bench_track_linking.py [--rivals]

The rivals (`pip install --group bench`) get the same fragments, in pixels of one tangent plane.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.tracking.linking.chains import Fragments, LinkRule, chain_heads
from epipole.tasks.algorithms.tracking.linking.likelihood_ratio import link_by_likelihood
from epipole.tasks.algorithms.tracking.linking.prediction import link_by_prediction

sys.path.append(str(Path(__file__).parents[1]))  # what tests share
from scenes.fragment_scenes import (
    FIELD_PX,
    FIELD_RAD,
    PIXEL_RAD,
    SIGMA_PX,
    BrokenTracks,
    broken_tracks,
)
from scenes.identity_score import identity_f1

Labels = npt.NDArray[np.int64]
# Objects, range of their gaps [s], duration [s].
CASES = [
    (60, (10, 20), 240.0),
    (60, (30, 60), 240.0),
    (250, (10, 20), 240.0),
    (250, (30, 60), 240.0),
    (250, (60, 120), 480.0),
    (250, (120, 300), 900.0),
]
MAX_GAP_S = 300.0  # told to the rivals: no gap of a case is longer by design
RULE = LinkRule(
    gap_s=np.inf,
    confidence=0.9999,
    field_sr=FIELD_RAD**2,
    interval_s=1.0,
    noise_rad2_s3=1e-3 * PIXEL_RAD**2,
)


def likelihood_ratio(scene: BrokenTracks) -> Labels:
    links = link_by_likelihood(Fragments(*scene[:4]), RULE)
    return np.repeat(chain_heads(links.before), np.diff(scene.offsets))


def prediction(scene: BrokenTracks) -> Labels:
    links = link_by_prediction(Fragments(*scene[:4]), RULE._replace(gap_s=MAX_GAP_S))
    return np.repeat(chain_heads(links.before), np.diff(scene.offsets))


def pixels(scene: BrokenTracks) -> Array:
    """Return the detections' places in one image: the plane about their mean direction."""
    middle = scene.u_icrs.mean(axis=0)
    middle /= np.linalg.norm(middle)
    e_1 = np.cross(middle, [0.0, 0.0, 1.0])
    e_1 /= np.linalg.norm(e_1)
    plane = np.stack([scene.u_icrs @ e_1, scene.u_icrs @ np.cross(middle, e_1)], axis=1)
    return plane / (scene.u_icrs @ middle)[:, None] / PIXEL_RAD + FIELD_PX / 2


def laptrack(scene: BrokenTracks) -> Labels:
    """Return the tracks of laptrack: its own linking of the detections, then gap closing.

    It closes gaps by distance alone; of three cut-offs the best counts.
    """
    import pandas
    from laptrack import LapTrack

    place = pixels(scene)
    columns = {"frame": scene.time_s.astype(int), "x": place[:, 0], "y": place[:, 1]}
    columns["row"] = np.arange(len(place))
    table = pandas.DataFrame(columns).sort_values("frame")
    truth = np.repeat(scene.truth, np.diff(scene.offsets))
    found = []
    for cutoff_px in (20.0, 50.0, 100.0):
        tracker = LapTrack(
            cutoff=10.0**2,
            gap_closing_cutoff=cutoff_px**2,
            gap_closing_max_frame_count=int(MAX_GAP_S),
        )
        tracks, _, _ = tracker.predict_dataframe(
            table, ["x", "y"], frame_col="frame", only_coordinate_cols=False
        )
        label = np.empty(len(place), np.int64)
        label[tracks["row"].to_numpy()] = tracks["track_id"].to_numpy()
        found.append(label)
    return max(found, key=lambda label: identity_f1(truth, label))


def stone_soup(scene: BrokenTracks) -> Labels:
    """Return the chains of Stone Soup's stitcher on fragments filtered with its own filters.

    Constant velocity with the process noise that suits the scene; forward, as backward
    prediction over negative time has no positive covariance there.
    """
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
    )
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.stitcher import TrackStitcher
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import KalmanUpdater

    place = pixels(scene)
    start = datetime(2019, 4, 1, 4)
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(1e-3)] * 2)
    camera = LinearGaussian(4, (0, 2), np.eye(2) * SIGMA_PX**2)
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(camera)
    tracks = []
    for lo, hi in zip(scene.offsets[:-1], scene.offsets[1:], strict=True):
        x, y = place[lo]
        when = start + timedelta(seconds=float(scene.time_s[lo]))
        state = GaussianState([x, 0, y, 0], np.diag([SIGMA_PX**2, 25, SIGMA_PX**2, 25]), when)
        track = Track([state])
        for k in range(lo + 1, hi):
            when = start + timedelta(seconds=float(scene.time_s[k]))
            seen = Detection(place[k], timestamp=when)
            ahead = predictor.predict(track[-1], timestamp=when)
            track.append(updater.update(SingleHypothesis(ahead, seen)))
        tracks.append(track)
    stitcher = TrackStitcher(
        forward_hypothesiser=DistanceHypothesiser(
            predictor, updater, Mahalanobis(), missed_distance=6.0
        ),
        search_window=timedelta(seconds=MAX_GAP_S),
    )
    _, chains = stitcher.stitch(tracks, start)
    number = {track.id: k for k, track in enumerate(tracks)}
    head = np.arange(len(tracks))
    for members in chains.values():
        joined = [number[i] for i in members]
        head[joined] = min(joined)
    return np.repeat(head, np.diff(scene.offsets))


def measure(
    method: Callable[[BrokenTracks], Labels], scenes: list[BrokenTracks], repeats: int
) -> str:
    """Return median IDF1 and the median CPU time of a method over the scenes, as text."""
    scores, seconds = [], []
    for scene in scenes:
        truth = np.repeat(scene.truth, np.diff(scene.offsets))
        method(scene)
        for _ in range(repeats):
            began = time.process_time()
            found = method(scene)
            seconds.append(time.process_time() - began)
        scores.append(100 * identity_f1(truth, found))
    return f"{np.median(scores):7.2f} {min(scores):7.2f} {1e3 * np.median(seconds):12.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rivals", action="store_true", help="Stone Soup and laptrack as well")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--mixed", action="store_true", help="orbits of any height")
    chosen = parser.parse_args()
    warnings.filterwarnings("ignore")
    print(f"{'objects':>7} {'gap s':>7} {'method':<18} {'IDF1 %':>7} {'lowest':>7} {'CPU ms':>12}")
    for n, gap, duration_s in CASES:
        seeds = range(chosen.first, chosen.first + chosen.seeds)
        scenes = [
            broken_tracks(seed, n, gap, belt=not chosen.mixed, duration_s=duration_s)
            for seed in seeds
        ]
        rows = [
            ("likelihood ratio", likelihood_ratio, scenes, 5),
            ("prediction [D]", prediction, scenes, 5),
        ]
        if chosen.rivals:  # they take minutes
            rows += [
                ("laptrack", laptrack, scenes[:2], 1),
                ("Stone Soup", stone_soup, scenes[:1], 1),
            ]
        for name, method, some, repeats in rows:
            text = measure(method, some, repeats)
            print(f"{n:>7} {gap[0]:>3}-{gap[1]:<3} {name:<18} {text}", flush=True)


if __name__ == "__main__":
    main()
