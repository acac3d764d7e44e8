"""Build tracklets: detections of one sensor, frame after frame, become runs of one object."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, concat, empty, nullable, table
from epipole.schemas.methods import TRACK_LINKING, load_method
from epipole.schemas.settings import Settings, TrackletSettings
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import TRACKLET_RUNS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.time.epoch_grid import frame_interval_ns
from epipole.tasks.algorithms.tracking.linking.chains import (
    Fragments,
    LinkRule,
    Links,
    chain_heads,
)
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.algorithms.tracking.runs import NONE, follow_detections
from epipole.tasks.common.sightings import (
    Frames,
    Sightings,
    camera_of,
    image_sightings_of,
    part_of,
    sightings_of,
    solved_frames,
    unsolved_frames,
)
from epipole.tasks.track.classify_detections import (
    at_hot_pixel,
    at_star,
    is_hot_pixel,
    is_planet,
    sighting_sigma,
)

Array = npt.NDArray[np.float64]

STAR_RATE_SIGMA = 4.0  # a tracklet that moves by less than this many sigmas stands still
# rad/s: and one slower than this, however well that is known. What drifts so slowly is a star in
# a field whose optics err by a tenth of a pixel: an object in orbit seen from another moves by
# arcseconds a second.
STAR_DRIFT = 0.05 * ARCSEC
STAR_RATE_KNOWN = 1.0 * ARCSEC  # rad/s: a rate not known this well does not make it a star


class Tracked(NamedTuple):
    """Detections with their tracklets, and the tracklets."""

    detections: pa.Table
    tracklets: pa.Table


def build_tracklets(
    solutions: pa.Table, detections: pa.Table, cameras: pa.Table, settings: Settings
) -> Tracked:
    """Return one sensor's detections with tracklet_id, track_id and kind, and its tracklets.

    Frames with an attitude are tracked on the sky. Those without are tracked in the image, a
    run of them for itself: there stars move with the objects and cannot be told from them.
    """
    if not detections.num_rows:
        return Tracked(detections, empty(TRACKLET_RUNS))
    labels = _Labels(
        np.full(detections.num_rows, "unknown", dtype=object),
        *(np.full(detections.num_rows, None, dtype=object) for _ in range(2)),
    )
    tracklets = [
        _label(part, labels, detections, settings)
        for part in _parts(solutions, detections, cameras)
    ]
    columns = {name: detections[name] for name in DETECTIONS.names} | labels._asdict()
    built = concat(TRACKLET_RUNS, tracklets)
    return Tracked(
        table(DETECTIONS, columns),
        built.sort_by([("start_time", "ascending"), ("tracklet_id", "ascending")]),
    )


class _Labels(NamedTuple):
    """What is said of each detection; written as it is found."""

    kind: npt.NDArray[np.object_]
    tracklet_id: npt.NDArray[np.object_]
    track_id: npt.NDArray[np.object_]


class _Part(NamedTuple):
    """Frames that are tracked together, and what they show."""

    frames: Frames
    seen: Sightings
    camera: Camera
    interval_s: float
    on_sky: bool


def _parts(solutions: pa.Table, detections: pa.Table, cameras: pa.Table) -> Iterator[_Part]:
    """Yield the frames with an attitude, and those without."""
    frames = solved_frames(solutions)
    if len(frames.number):
        camera = camera_of(cameras, int(frames.camera[0]))
        interval_s = frame_interval_ns(frames.time_ns) / 1e9
        yield _Part(frames, sightings_of(frames, detections), camera, interval_s, True)
    lost = unsolved_frames(solutions)
    if len(lost.number):
        camera = camera_of(cameras, int(lost.camera[0]))
        # Of all frames: those that were lost may be far between.
        interval_s = frame_interval_ns(np.sort(array(solutions, "time"))) / 1e9
        seen = image_sightings_of(lost, detections, camera)
        yield _Part(lost, seen, camera, interval_s, False)


def _follow(part: _Part, seen: Sightings, settings: TrackletSettings) -> npt.NDArray[np.int64]:
    """Return the track number of every sighting."""
    frames, camera, interval_s = part.frames, part.camera, part.interval_s
    return follow_detections(
        (frames.time_ns - frames.time_ns[0]) / 1e9,
        seen.offsets,
        seen.u_icrs,
        sighting_sigma(seen),
        max_rate_rad_s=np.radians(settings.max_rate_deg_s),
        # Half a frame of slack, for jitter.
        max_coast_s=(settings.max_missed + 1.5) * interval_s,
        max_missed=settings.max_missed,
        min_detections=settings.min_detections,
        gate_sigma=settings.gate_sigma,
        field_sr=camera.width * camera.height * camera.pixel_rad**2,
        false_alarm=settings.false_alarm,
    )


class _Run(NamedTuple):
    """One track's sightings and what they show."""

    members: npt.NDArray[np.int64]
    rate_rad_s: float
    stands_still: bool
    residual_px: float


def _label(part: _Part, labels: _Labels, detections: pa.Table, settings: Settings) -> pa.Table:
    """Say what the detections of some frames are; return their tracklets."""
    frames, seen, camera = part.frames, part.seen, part.camera
    known = labels.kind == "hot_pixel"
    hot = is_hot_pixel(frames, seen, detections, camera)
    hot |= at_hot_pixel(seen, detections, known, camera)
    labels.kind[seen.row[hot]] = "hot_pixel"
    planet = np.zeros_like(hot)
    if part.on_sky:
        planet = is_planet(frames, seen, camera) & ~hot
        labels.kind[seen.row[planet]] = "planet"
    seen = part_of(seen, ~hot & ~planet)
    track = _follow(part, seen, settings.tracklets)
    runs = _runs(frames, seen, track, camera, settings.alignment.window_s)
    if part.on_sky:
        stars = [run for run in runs if run.stands_still]
        runs = [run for run in runs if not run.stands_still]
        _label_stars(labels, seen, stars, np.flatnonzero(track == NONE))
    sensor_id = str(detections["sensor_id"][0])
    objects = sorted(runs, key=lambda run: int(run.members[0]))
    names = [_name(sensor_id, frames, seen, detections, run) for run in objects]
    links = _link(part, seen, objects, settings)
    heads = [names[head] for head in chain_heads(links.before)]
    for run, name, head in zip(objects, names, heads, strict=True):
        labels.kind[seen.row[run.members]] = "object"
        labels.tracklet_id[seen.row[run.members]] = name
        labels.track_id[seen.row[run.members]] = head
    return _tracklet_table(frames, seen, objects, names, heads, links.chi2, sensor_id)


def _label_stars(
    labels: _Labels, seen: Sightings, stars: list[_Run], single: npt.NDArray[np.int64]
) -> None:
    """Label runs that stand still, and single sightings at their places, as unlisted stars."""
    for run in stars:
        labels.kind[seen.row[run.members]] = "star_unlisted"
    places = np.array([seen.u_icrs[run.members].mean(axis=0) for run in stars])
    labels.kind[seen.row[single[at_star(seen, single, places)]]] = "star_unlisted"


def _name(sensor_id: str, frames: Frames, seen: Sightings, detections: pa.Table, run: _Run) -> str:
    """Return a tracklet's id: the frame and centroid in which it begins name it.

    So it is the same, whatever else the night holds.
    """
    first = run.members[0]
    centroid = detections["centroid"][int(seen.row[first])].as_py()
    return f"{sensor_id}-{frames.number[seen.frame[first]]}-{centroid}"


def _link(part: _Part, seen: Sightings, runs: list[_Run], settings: Settings) -> Links:
    """Return which run continues which, by the method that the settings name."""
    chosen, frames, camera = settings.tracklets, part.frames, part.camera
    if not runs:
        return Links(np.full(len(runs), NONE), np.full(len(runs), np.nan))
    members = np.concatenate([run.members for run in runs])
    offsets = np.cumsum([0, *(len(run.members) for run in runs)])
    fragments = Fragments(
        offsets.astype(np.int64),
        (frames.time_ns[seen.frame[members]] - frames.time_ns[0]) / 1e9,
        seen.u_icrs[members],
        sighting_sigma(seen)[members],
    )
    rule = LinkRule(
        gap_s=chosen.link_gap_s,
        kept=chosen.link_kept,
        field_sr=camera.width * camera.height * camera.pixel_rad**2,
        interval_s=part.interval_s,
        noise_rad2_s3=chosen.link_noise_px * camera.pixel_rad**2,
    )
    links: Links = load_method(TRACK_LINKING, chosen.link_method)(fragments, rule)
    return links


def _runs(
    frames: Frames,
    seen: Sightings,
    track: npt.NDArray[np.int64],
    camera: Camera,
    window_s: float,
) -> list[_Run]:
    """Return what each track shows, in the order in which they were confirmed."""
    order = np.lexsort((seen.frame, track))
    order = order[track[order] != NONE]
    bounds = np.flatnonzero(np.diff(track[order], prepend=NONE, append=NONE))
    time_s = (frames.time_ns[seen.frame] - frames.time_ns[0]) / 1e9
    first = np.repeat(bounds[:-1], np.diff(bounds))
    last = np.repeat(bounds[1:], np.diff(bounds))
    smooth, *_ = directions_at(
        first, last, time_s[order], 0.0, time_s[order], seen.u_icrs[order],
        seen.cov_noise[order], seen.cov_bias[order], window_s,
    )  # fmt: skip
    miss = np.linalg.norm(seen.u_icrs[order] - smooth, axis=1)
    out = []
    for lo, hi in itertools.pairwise(bounds):
        members = order[lo:hi]
        rate, sigma = _mean_rate(time_s[members], seen.u_icrs[members], seen.cov_noise[members])
        still = rate < max(STAR_RATE_SIGMA * sigma, STAR_DRIFT) and sigma < STAR_RATE_KNOWN
        residual = float(np.sqrt(np.mean(miss[lo:hi] ** 2) / 2)) / camera.pixel_rad
        out.append(_Run(members, rate, still, residual))
    return out


def _mean_rate(time_s: Array, u: Array, cov_noise: Array) -> tuple[float, float]:
    """Return the mean rate of a run and its 1-sigma error [rad/s]."""
    t = time_s - time_s.mean()
    lever = float(np.sum(t * t))
    slope = t @ (u - u[0]) / lever
    sigma = np.sqrt(np.mean(np.trace(cov_noise, axis1=1, axis2=2)) / lever)
    return float(np.linalg.norm(slope)), float(sigma)


def _tracklet_table(
    frames: Frames,
    seen: Sightings,
    runs: list[_Run],
    names: list[str],
    heads: list[str],
    link_chi2: Array,
    sensor_id: str,
) -> pa.Table:
    time_ns = frames.time_ns[seen.frame]
    return table(
        TRACKLET_RUNS,
        {
            "tracklet_id": names,
            "track_id": heads,
            "sensor_id": [sensor_id] * len(runs),
            "start_time": np.array([time_ns[run.members[0]] for run in runs], np.int64),
            "end_time": np.array([time_ns[run.members[-1]] for run in runs], np.int64),
            "n_detections": [len(run.members) for run in runs],
            "rate_arcsec_s": [run.rate_rad_s / ARCSEC for run in runs],
            "residual_px": [run.residual_px for run in runs],
            "link_chi2": nullable(link_chi2),
        },
    )
