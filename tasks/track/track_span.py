"""Track a span: one sensor's tracklets over a span and its margins.

`track_spans` reads the parts of a span and its margins and calls `build_tracklets`. For the frames
with an attitude, and apart from them for the others, that does these steps (`_label`):

1. Hot pixels and planets are labelled and set aside.
2. The other detections are followed from frame to frame: each run becomes a track (`_follow`).
3. Rate and residual of each track are measured (`measure_runs`). Tracks that stand still are stars.
4. Suspected hot pixels that belong to no track are labelled as such.
5. The remaining tracks are objects: broken ones are linked, named, and written as tracklets
   (`_label_objects`).
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.work.kept_parts import part_key
from epipole.io.work.parts import TRACKED, Parts, write_part
from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import array, concat, empty, nullable, table
from epipole.schemas.options import TRACK_LINKING, load_method
from epipole.schemas.settings import TrackletSettings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import DETECTIONS, STARS
from epipole.schemas.work_tables import HOT_SUSPECTS, SOLUTIONS, TRACKLET_RUNS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.geometry.directions import lengths
from epipole.tasks.algorithms.times import frame_interval_ns, frame_intervals_ns
from epipole.tasks.algorithms.tracking.hot_pixels import CERTAIN, LIKELY, NOWHERE
from epipole.tasks.algorithms.tracking.linking.chains import (
    Fragments,
    LinkRule,
    Links,
    chain_heads,
)
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.algorithms.tracking.runs import NONE, SkyDetections, follow_detections
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.sightings import (
    Frames,
    Sightings,
    by_camera,
    camera_of,
    cameras_of,
    image_sightings_of,
    max_coast,
    part_of,
    sightings_of,
    solved_frames,
    unsolved_frames,
)
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.track.classify_detections import (
    at_hot_pixel,
    at_star,
    is_planet,
    sighting_sigma,
    star_directions,
    stated_sigma_px,
    static_positions,
)

# Measurement of runs: rates, residuals, and which of them stand still like stars.


STAR_RATE_SIGMA = 4.0  # a run whose rate is smaller than this many sigmas stands still
# rad/s: a slower run stands still, however well its rate is known. Errors of the optics of a tenth
# of a pixel let stars drift this fast. Objects in orbit move by arcseconds per second.
STAR_DRIFT = 0.05 * ARCSEC
STAR_RATE_KNOWN = 1.0 * ARCSEC  # rad/s: with a larger sigma, a run is not taken for a star
# An object whose apparent motion turns back has a mean rate of zero too, but not in both halves of
# its run. The limits are wider there: errors of the optics differ over the image. Shorter halves
# show too little.
HALF_RATE_SIGMA, HALF_DRIFT, MIN_HALF = 6.0, 4 * STAR_DRIFT, 10


MOST_AT_STAR = 0.5  # share of a resting run's detections that must lie at one


class TrackRun(NamedTuple):
    """The sightings of one track, in order of time, and its motion.

    It `rests` where its rate agrees with that of a star, over all of it and in both halves. It
    `stands_still` where besides the rate is known well enough to exclude an object in orbit.
    """

    members: Integers
    rate_rad_s: float
    rests: bool
    stands_still: bool
    residual_px: float


def measure_runs(
    frames: Frames,
    sightings: Sightings,
    track: Integers,
    cameras: pa.Table,
    window_s: float,
) -> list[TrackRun]:
    """Return the runs of tracks, by track number.

    Parameters
    ----------
    track : (n,) int
        Track of each sighting; NONE where it belongs to none.
    cameras
        CAMERAS of the frames.
    window_s
        Half-width of the local motion that residuals are taken from.
    """
    order = np.lexsort((sightings.frame, track))
    order = order[track[order] != NONE]
    bounds = np.flatnonzero(np.diff(track[order], prepend=NONE, append=NONE))
    time_s = (sightings.time_ns - frames.time_ns[0]) / 1e9
    first = np.repeat(bounds[:-1], np.diff(bounds))
    last = np.repeat(bounds[1:], np.diff(bounds))
    u, t = np.take(sightings.u_icrs, order, axis=0), time_s[order]
    noise = np.take(sightings.cov_noise, order, axis=0)
    bias = np.take(sightings.cov_bias, order, axis=0)
    smooth, *_ = directions_at(first, last, t, 0.0, t, u, noise, bias, window_s)
    miss, pixel_rad = lengths(u - smooth), camera_of(cameras, int(frames.camera[0])).pixel_rad
    for row, of in by_camera(frames.camera[sightings.frame[order]]):
        miss[of] *= pixel_rad / camera_of(cameras, row).pixel_rad
    variance, from_prior = traces(noise), ~frames.from_stars[sightings.frame[order]]
    runs = []
    for lo, hi in itertools.pairwise(bounds):
        members = order[lo:hi]
        seen = t[lo:hi], u[lo:hi], variance[lo:hi]
        rate, sigma = _mean_rate(*seen, from_prior[lo:hi].any())
        rests = rate < max(STAR_RATE_SIGMA * sigma, STAR_DRIFT)
        rests = rests and _halves_rest(*seen, from_prior[lo:hi].any())
        still = rests and sigma < STAR_RATE_KNOWN
        residual = float(np.sqrt(np.mean(miss[lo:hi] ** 2) / 2)) / pixel_rad
        runs.append(TrackRun(members, rate, rests, still, residual))
    return runs


def _mean_rate(time_s: Array, u: Array, variance: Array, from_prior: bool) -> tuple[float, float]:
    """Return the mean rate of a run and its 1-sigma error [rad/s].

    `variance` is the trace of each direction's independent error [rad^2]. What part of a prior
    attitude's error changes from frame to frame no log says: `from_prior`, the run itself shows it.
    """
    t = time_s - time_s.mean()
    lever = float(np.sum(t * t))
    slope = t @ (u - u[0]) / lever
    mean = float(np.mean(variance))
    if from_prior:
        miss = u - u.mean(axis=0) - t[:, None] * slope
        mean = max(mean, float(np.sum(miss**2)) / max(len(t) - 2, 1))
    return float(np.linalg.norm(slope)), float(np.sqrt(mean / lever))


def _halves_rest(time_s: Array, u: Array, variance: Array, from_prior: bool) -> bool:
    """Return whether both halves of a run rest too; arguments as in `_mean_rate`."""
    middle = len(time_s) // 2
    if middle < MIN_HALF:
        return True
    for part in (slice(None, middle), slice(middle, None)):
        rate, sigma = _mean_rate(time_s[part], u[part], variance[part], from_prior)
        if not rate < max(HALF_RATE_SIGMA * sigma, HALF_DRIFT):
            return False
    return True


# Tracklets: runs of detections of one object in the frames of one sensor.


class Tracked(NamedTuple):
    """DETECTIONS with their tracklets, TRACKLET_RUNS, and HOT_SUSPECTS among them."""

    detections: pa.Table
    tracklets: pa.Table
    suspects: pa.Table


def build_tracklets(
    solutions: pa.Table,
    detections: pa.Table,
    cameras: pa.Table,
    settings: TrackletSettings,
    half_width_s: float,
    stars: pa.Table | None = None,
) -> Tracked:
    """Return one sensor's detections with tracklet_id, track_id and kind, and its tracklets.

    `stars` are the STARS of the sensor: what rests where one is identified in other frames is it.
    `half_width_s` is the time on each side of a detection in which its motion is fitted.

    Frames with an attitude are tracked on the sky. Frames without are tracked apart from them, in
    the image. There stars move like objects and cannot be distinguished from them.
    """
    if not detections.num_rows:
        return Tracked(detections, empty(TRACKLET_RUNS), empty(HOT_SUSPECTS))
    labels = _Labels(
        np.full(detections.num_rows, "unknown", dtype=object),
        *(np.full(detections.num_rows, None, dtype=object) for _ in range(2)),
    )
    identified = empty(STARS) if stars is None else stars
    parts = [
        _label(part, labels, detections, settings, half_width_s, identified)
        for part in _parts(solutions, detections, cameras)
    ]
    columns = {name: detections[name] for name in DETECTIONS.names} | labels._asdict()
    built = concat(TRACKLET_RUNS, [tracklets for tracklets, _ in parts])
    return Tracked(
        table(DETECTIONS, columns),
        built.sort_by([("start_time", "ascending"), ("tracklet_id", "ascending")]),
        concat(HOT_SUSPECTS, [suspects for _, suspects in parts]),
    )


class _Labels(NamedTuple):
    """Kind and ids of each detection, filled step by step."""

    kind: npt.NDArray[np.object_]
    tracklet_id: npt.NDArray[np.object_]
    track_id: npt.NDArray[np.object_]


class _TrackedFrames(NamedTuple):
    """Frames that are tracked together, and their sightings."""

    frames: Frames
    sightings: Sightings
    camera: Camera  # of the first frame
    cameras: pa.Table  # of all
    interval_s: float
    intervals_s: Array  # about each frame
    on_sky: bool


def _parts(
    solutions: pa.Table, detections: pa.Table, cameras: pa.Table
) -> Iterator[_TrackedFrames]:
    """Yield the frames with an attitude, then the frames without."""
    frames = solved_frames(solutions)
    if len(frames.number):
        camera = camera_of(cameras, int(frames.camera[0]))
        intervals_s = _intervals_s(frames.time_ns, frames)
        seen = sightings_of(frames, detections, cameras)
        yield _TrackedFrames(frames, seen, camera, cameras, *intervals_s, True)
    unsolved = unsolved_frames(solutions)
    if len(unsolved.number):
        camera = camera_of(cameras, int(unsolved.camera[0]))
        # The intervals of all frames: frames without an attitude may be far apart.
        intervals_s = _intervals_s(np.sort(array(solutions, "time")), unsolved)
        sightings = image_sightings_of(unsolved, detections, cameras)
        yield _TrackedFrames(unsolved, sightings, camera, cameras, *intervals_s, False)


def _intervals_s(time_ns: Integers, frames: Frames) -> tuple[float, Array]:
    """Return the usual interval of frames at some times, and that about each of `frames`, which are
    among these [s]."""
    about = frame_intervals_ns(time_ns)[np.searchsorted(time_ns, frames.time_ns)]
    return frame_interval_ns(time_ns) / 1e9, about / 1e9


def _follow(
    part: _TrackedFrames, sightings: Sightings, detections: pa.Table, settings: TrackletSettings
) -> Integers:
    """Return the track number of each sighting; NONE where it belongs to no track."""
    frames, camera = part.frames, part.camera
    seen = SkyDetections(
        (frames.time_ns - frames.time_ns[0]) / 1e9,
        sightings.offsets,
        sightings.u_icrs,
        sighting_sigma(sightings),
        array(detections, "flux").astype(float)[sightings.row],
    )
    return follow_detections(
        seen,
        max_rate_rad_s=np.radians(settings.max_rate_deg_s),
        max_coast_s=max_coast(part.intervals_s, settings),
        max_missed=settings.max_missed,
        min_detections=settings.min_detections,
        gate_sigma=settings.gate_sigma,
        field_sr=camera.width * camera.height * camera.pixel_rad**2,
        false_alarm=settings.false_alarm,
        false_alarm_sequence=settings.false_alarm_sequence,
    )


def _label(
    part: _TrackedFrames,
    labels: _Labels,
    detections: pa.Table,
    settings: TrackletSettings,
    half_width_s: float,
    identified: pa.Table,
) -> tuple[pa.Table, pa.Table]:
    """Label the detections of some frames; return their tracklets, and those that may be hot."""
    frames, sightings, camera = part.frames, part.sightings, part.camera
    known = labels.kind == "hot_pixel"
    sigma_px = stated_sigma_px(frames, sightings, detections, part.cameras)
    fixed = static_positions(frames, sightings, detections, sigma_px, camera)
    hot = fixed.with_odds(CERTAIN) | at_hot_pixel(sightings, detections, known, sigma_px)
    labels.kind[sightings.row[hot]] = "hot_pixel"
    planet = np.zeros_like(hot)
    if part.on_sky:
        planet = is_planet(frames, sightings, part.cameras) & ~hot
        labels.kind[sightings.row[planet]] = "planet"
    kept = ~hot & ~planet
    sightings, suspected = part_of(sightings, kept), fixed.with_odds(LIKELY)[kept]
    track = _follow(part, sightings, detections, settings)
    runs = measure_runs(frames, sightings, track, part.cameras, half_width_s)
    if part.on_sky:
        u_stars = star_directions(frames, identified, part.cameras)
        still = _unlisted_stars(sightings, runs, u_stars)
        stars = [run for run, is_star in zip(runs, still, strict=True) if is_star]
        runs = [run for run, is_star in zip(runs, still, strict=True) if not is_star]
        _label_stars(labels, sightings, stars, u_stars, np.flatnonzero(track == NONE))
    # What no run holds, no other sensor can confirm.
    in_runs = _in_runs(fixed.position[kept], runs)
    labels.kind[sightings.row[suspected & ~in_runs]] = "hot_pixel"
    objects = sorted(runs, key=lambda run: int(run.members[0]))
    return _label_objects(part, sightings, objects, labels, detections, settings, suspected)


def _in_runs(position: Integers, runs: list[TrackRun]) -> Flags:
    """Return which sightings are at a pixel position that a run has a sighting at."""
    members = np.concatenate([np.zeros(0, np.int64), *(run.members for run in runs)])
    return np.isin(position, np.setdiff1d(position[members], [NOWHERE]))


def _label_objects(
    part: _TrackedFrames,
    sightings: Sightings,
    objects: list[TrackRun],
    labels: _Labels,
    detections: pa.Table,
    settings: TrackletSettings,
    suspected: Flags,
) -> tuple[pa.Table, pa.Table]:
    """Label the sightings of objects; return their TRACKLET_RUNS and HOT_SUSPECTS."""
    sensor_id = str(detections["sensor_id"][0])
    names = [_name(sensor_id, part.frames, sightings, detections, run) for run in objects]
    links = _link(part, sightings, objects, settings)
    heads = [names[head] for head in chain_heads(links.before)]
    for run, name, head in zip(objects, names, heads, strict=True):
        labels.kind[sightings.row[run.members]] = "object"
        labels.tracklet_id[sightings.row[run.members]] = name
        labels.track_id[sightings.row[run.members]] = head
    at_suspect = [suspected[run.members].mean() > 0.5 for run in objects]
    suspects = [name for name, at in zip(names, at_suspect, strict=True) if at]
    rows = _tracklet_table(part.frames, sightings, objects, names, heads, links.chi2, sensor_id)
    return rows, table(HOT_SUSPECTS, {"tracklet_id": suspects})


def _label_stars(
    labels: _Labels,
    sightings: Sightings,
    stars: list[TrackRun],
    u_stars: Array,
    single: Integers,
) -> None:
    """Label the runs of unlisted stars, and single sightings at these or at identified stars."""
    for run in stars:
        labels.kind[sightings.row[run.members]] = "star_unlisted"
    directions = np.concatenate([u_stars, _mean_directions(sightings, stars)])
    labels.kind[sightings.row[single[at_star(sightings, single, directions)]]] = "star_unlisted"


def _unlisted_stars(sightings: Sightings, runs: list[TrackRun], u_stars: Array) -> list[bool]:
    """Return which runs are stars: they stand still; or they rest, and a star is identified there
    in other frames, or another run stands still there.

    A star that lies far from its position in the catalogue, a double or one of large proper motion,
    is identified in a part of its frames. In the others it makes runs too short to know their
    rates.
    """
    still = [run.stands_still for run in runs]
    resting = [k for k, run in enumerate(runs) if run.rests and not run.stands_still]
    if not resting:
        return still
    others = [run for run in runs if run.stands_still]
    directions = np.concatenate([u_stars, _mean_directions(sightings, others)])
    for k in resting:
        members = runs[k].members
        still[k] = bool(at_star(sightings, members, directions).mean() > MOST_AT_STAR)
    return still


def _mean_directions(sightings: Sightings, runs: list[TrackRun]) -> Array:
    """Return the mean direction of each run, (r, 3)."""
    means = [sightings.u_icrs[run.members].mean(axis=0) for run in runs]
    return np.array(means).reshape(-1, 3)


def _name(
    sensor_id: str, frames: Frames, sightings: Sightings, detections: pa.Table, run: TrackRun
) -> str:
    """Return a tracklet's id: its sensor, and the frame and centroid of its first detection.

    So the id does not depend on the rest of the night.
    """
    first = run.members[0]
    centroid = detections["centroid"][int(sightings.row[first])].as_py()
    return f"{sensor_id}-{frames.number[sightings.frame[first]]}-{centroid}"


def _link(
    part: _TrackedFrames, sightings: Sightings, runs: list[TrackRun], settings: TrackletSettings
) -> Links:
    """Return which run continues which, by the method of the settings."""
    chosen, frames, camera = settings, part.frames, part.camera
    if not runs:
        return Links(np.full(0, NONE), np.full(0, np.nan))
    members = np.concatenate([run.members for run in runs])
    offsets = np.cumsum([0, *(len(run.members) for run in runs)])
    fragments = Fragments(
        offsets.astype(np.int64),
        (sightings.time_ns[members] - frames.time_ns[0]) / 1e9,
        sightings.u_icrs[members],
        sighting_sigma(sightings)[members],
    )
    rule = LinkRule(
        gap_s=np.inf if chosen.link_gap_s is None else chosen.link_gap_s,
        confidence=chosen.link_kept,
        field_sr=camera.width * camera.height * camera.pixel_rad**2,
        interval_s=part.interval_s,
        noise_rad2_s3=chosen.link_noise_px * camera.pixel_rad**2,
    )
    links: Links = load_method(TRACK_LINKING, chosen.link_method)(fragments, rule)
    return links


def _tracklet_table(
    frames: Frames,
    sightings: Sightings,
    runs: list[TrackRun],
    names: list[str],
    heads: list[str],
    link_chi2: Array,
    sensor_id: str,
) -> pa.Table:
    time_ns = frames.time_ns[sightings.frame]
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


# From part to part.

# Tracklets are followed this long before and after a span, so that neighbouring spans find the same
# ones; and this long in addition, so that broken tracks are joined across the border.
MARGIN_S = 90.0
LINK_MARGIN_S = 90.0


def track_margin_ns(settings: TrackletSettings) -> int:
    """Return how far before and after a span its detections are followed."""
    return round((MARGIN_S + (settings.link_gap_s or LINK_MARGIN_S)) * 1e9)


class SpanToTrack(NamedTuple):
    """A sensor's detections of a span: its parts of `identify_spans`, and where the part goes.

    The part is `TRACKED`, with the tracklets' names in the span.
    """

    sensor: Sensor
    span: Span
    identified: Parts
    parts: Parts

    def __str__(self) -> str:
        """Return the sensor and the times of day."""
        return f"{self.sensor} {self.span}"


@stage_task(Stage.TRACK, "{spans}")
def track_spans(
    spans: Batch[SpanToTrack], cameras: pa.Table, settings: TrackletSettings, half_width_s: float
) -> list[int]:
    """Follow detections through some spans and their margins, unless the parts exist.

    Returns
    -------
    list of int
        The number of detections in each part.
    """
    return [
        _track_span(each, cameras_of(cameras, each.sensor.sensor_id), settings, half_width_s)
        for each in spans
    ]


def _track_span(
    work: SpanToTrack, cameras: pa.Table, settings: TrackletSettings, half_width_s: float
) -> int:
    _, span, identified, parts = work
    if not parts.holds(span):
        wide = span.widened(track_margin_ns(settings))
        read = identified.written(identified.near(wide))
        key = part_key([Stage.TRACK, span], parts=read)
        if parts.take(span, key):
            return _n_detections(parts, span)
        tracked = build_tracklets(
            identified.rows_within(wide, SOLUTIONS, "solutions"),
            identified.rows_within(wide, DETECTIONS, "detections"),
            cameras,
            settings,
            half_width_s,
            identified.rows_within(wide, STARS, "stars"),
        )
        write_part(parts.of(span), TRACKED, tracked._asdict(), key=key)
    return _n_detections(parts, span)


def _n_detections(parts: Parts, span: Span) -> int:
    return parts.read(span, "detections", ["time"]).num_rows
