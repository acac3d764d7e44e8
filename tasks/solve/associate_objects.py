"""Associate objects: which sensors' tracklets are one object, span by span of the night."""

import logging
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, concat, stack, table
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS
from epipole.tasks.algorithms.association.epipolar_lines import associate_by_lines
from epipole.tasks.algorithms.association.likelihood import Shell, associate_tracklets
from epipole.tasks.algorithms.association.sampling.samples import Groups, Samples
from epipole.tasks.algorithms.association.verdicts import NightViews, Verdicts
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.algorithms.orbits.object_identity import ObjectRegistry
from epipole.tasks.algorithms.sensor_faults.agreement import agreement
from epipole.tasks.common.sightings import camera_of, solved_frames

LOGGER = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MOST_SAMPLES = 12  # instants in a span
LONGER_S = (120.0, 600.0)  # whole numbers of them make the half hours that nights are cut into
NEAR_NS = 2_000_000_000  # a frame this near tells where a sensor looks


class Associated(NamedTuple):
    """Views that belong to an object, each with its object's number; and what was left out."""

    views: pa.Table
    object_number: Indices
    rejects: pa.Table


def associate_objects(
    views: pa.Table,
    tracklets: pa.Table,
    solutions: pa.Table,
    cameras: pa.Table,
    settings: Settings,
) -> Associated:
    """Return the views that are objects seen by two sensors or more, and which object each is.

    Object numbers count from 0 in the order of first appearance and hold from span to span as
    long as a track of the object goes on. A sensor that disagrees with all others is left out.
    """
    views = views.sort_by([("epoch", "ascending"), ("sensor_id", "ascending"),
                           ("tracklet_id", "ascending")])  # fmt: skip
    night = _Night(views, tracklets, solutions, cameras)
    spans = night.spans(settings.association.span_s)
    verdicts = Verdicts(night.seen(spans))
    rejects: list[pa.Table] = []
    left_out: set[str] = set()
    believed = np.ones(views.num_rows, bool)
    for rows in spans:
        instants = night.instants(rows, settings.alignment.window_s)
        samples, tracklet = night.samples(rows, instants)
        groups = _solve(night, samples, settings)
        wrong = agreement(samples, groups).disagreeing()
        if len(wrong):
            rejects.append(_disagreeing(night, rows, wrong))
            left_out.update(night.sensors[wrong].tolist())
            believed[rows] = ~np.isin(night.sensor[rows], wrong)
            rows = rows[believed[rows]]
            if not len(rows):
                continue
            instants = night.instants(rows, settings.alignment.window_s)
            samples, tracklet = night.samples(rows, instants)
            groups = _solve(night, samples, settings)
        verdicts.enter(rows, tracklet, groups)
    if settings.association.method == "likelihood":
        _judge_again(night, verdicts, believed, settings)
    number = _numbered(night, verdicts.group, spans)
    rejects += [
        _ambiguous(night, rows, np.unique(night.tracklet[rows[verdicts.ambiguous[rows]]]))
        for rows in spans
        if verdicts.ambiguous[rows].any()
    ]
    if left_out:
        LOGGER.warning(
            "%s: lines of sight agree with no other sensor's (clock, position or attitude "
            "wrong?): left out where they do not", ", ".join(sorted(left_out)),
        )  # fmt: skip
    number = _seen_by_two(night, number)
    chosen = np.flatnonzero(number >= 0)
    return Associated(views.take(chosen), number[chosen], concat(REJECTS, rejects))


def _judge_again(
    night: "_Night", verdicts: Verdicts, believed: npt.NDArray[np.bool_], settings: Settings
) -> None:
    """Judge what is not sure over longer and longer windows in which its tracklets go on."""
    judged_s = settings.association.span_s
    for window_s in LONGER_S:
        if not judged_s < window_s <= settings.association.longest_span_s:
            continue
        for window in night.spans(window_s):
            rows = window[believed[window]]
            open_rows = verdicts.open_rows(rows, judged_s)
            if len(open_rows):
                instants = night.even_instants(rows, settings.alignment.window_s)
                samples, tracklet = night.samples(rows, instants)
                groups = _solve(night, samples, settings)
                verdicts.reconsider(rows, open_rows, tracklet, groups)
        judged_s = window_s


def _numbered(night: "_Night", group: Indices, spans: list[Indices]) -> Indices:
    """Return each view's object number: groups of one track are one object, span after span."""
    registry = ObjectRegistry()
    number = np.full(len(group), -1)
    for rows in spans:
        own = rows[group[rows] >= 0]
        groups, of_row = np.unique(group[own], return_inverse=True)
        objects = registry.name_groups(
            [np.unique(night.track[night.tracklet[own[of_row == g]]]) for g in range(len(groups))]
        )
        number[own] = np.array(objects, np.int64)[of_row]
    return number


def _solve(night: "_Night", samples: Samples, settings: Settings) -> Groups:
    chosen = settings.association
    if chosen.method == "epipolar":
        return associate_by_lines(samples, night.focal_px, chosen.threshold_px)
    return associate_tracklets(
        samples,
        gate_sigma=chosen.gate_sigma,
        min_altitude_km=chosen.min_altitude_km,
        max_range_km=chosen.max_range_km,
        min_log_odds=chosen.min_log_odds,
        ambiguity_log_odds=chosen.ambiguity_log_odds,
        shells=[Shell(s.lowest_km, s.highest_km, s.share) for s in chosen.shells],
    )


def _ambiguous(night: "_Night", rows: Indices, tracklet: Indices) -> pa.Table:
    """Return a reject row a sensor: how many of its tracklets could not be decided."""
    sensors, count = np.unique(night.sensor_of_tracklet[tracklet], return_counts=True)
    return _reject_table(night, rows, "ambiguous", sensors, count)


def _disagreeing(night: "_Night", rows: Indices, sensors: Indices) -> pa.Table:
    """Return a reject row for each sensor left out of a span: how many tracklets it had."""
    own = np.unique(np.column_stack([night.sensor[rows], night.tracklet[rows]]), axis=0)[:, 0]
    count = np.array([np.sum(own == s) for s in sensors])
    return _reject_table(night, rows, "sensor_disagrees", sensors, count)


def _reject_table(
    night: "_Night", rows: Indices, reason: str, sensors: Indices, count: Indices
) -> pa.Table:
    n = len(sensors)
    return table(
        REJECTS,
        {
            "source": pa.nulls(n, pa.string()),
            "offset": pa.nulls(n, pa.int64()),
            "sensor_id": night.sensors[sensors],
            "time": np.full(n, night.epoch_ns[rows[0]]),
            "stage": ["associate"] * n,
            "reason": [reason] * n,
            "count": count.astype(np.int64),
        },
    )


def _seen_by_two(night: "_Night", number: Indices) -> Indices:
    """Return the object numbers, -1 where at that epoch no second sensor sees the object.

    Of two fragments of one object in one sensor the one with a centroid in the frame, or else
    the first, speaks for the epoch: no sensor sees an object twice.
    """
    out = number.copy()
    grouped = np.flatnonzero(number >= 0)
    order = grouped[
        np.lexsort(
            (night.missed[grouped], night.sensor[grouped], number[grouped], night.epoch_ns[grouped])
        )
    ]
    key = np.column_stack([night.epoch_ns[order], number[order], night.sensor[order]])
    again = np.zeros(len(order), bool)
    again[1:] = (key[1:] == key[:-1]).all(axis=1)
    out[order[again]] = -1
    order, key = order[~again], key[~again]
    _, inverse, count = np.unique(key[:, :2], axis=0, return_inverse=True, return_counts=True)
    out[order[count[inverse.ravel()] < 2]] = -1
    return out


class _Night:
    """The views of all sensors as arrays, and the samples of a span of them."""

    def __init__(
        self, views: pa.Table, tracklets: pa.Table, solutions: pa.Table, cameras: pa.Table
    ) -> None:
        tracklets = tracklets.sort_by("tracklet_id")
        self.tracklet_id = array(tracklets, "tracklet_id").astype(str)
        # Fragments that the linking joined are one track: an object keeps its number by it.
        _, self.track = np.unique(array(tracklets, "track_id").astype(str), return_inverse=True)
        self.sensors, self.sensor_of_tracklet = np.unique(
            array(tracklets, "sensor_id").astype(str), return_inverse=True
        )
        self.start_ns, self.end_ns = array(tracklets, "start_time"), array(tracklets, "end_time")
        self.epoch_ns = array(views, "epoch")
        self.missed = ~views["centroid"].is_valid().to_numpy()
        self.sensor = np.searchsorted(self.sensors, array(views, "sensor_id").astype(str))
        self.tracklet = np.searchsorted(self.tracklet_id, array(views, "tracklet_id").astype(str))
        self.u, self.r_km = stack(views, "u{}"), stack(views, "{}_km")
        self.noise = _symmetric(views, "cov_noise_{}_rad2")
        self.bias = _symmetric(views, "cov_bias_{}_rad2")
        self.sigma_km = array(views, "position_sigma_km")
        self._look(solutions, cameras)

    def _look(self, solutions: pa.Table, cameras: pa.Table) -> None:
        """Keep where each sensor stands and looks, frame by frame, and how wide its field is."""
        self.frames, half_field, focal_px = [], [], []
        for sensor in self.sensors:
            frames = solved_frames(solutions.filter(pa.compute.field("sensor_id") == sensor))
            camera = camera_of(cameras, int(frames.camera[0]))
            self.frames.append((frames, matrix_from_quaternion(frames.q_sensor_from_icrs)))
            half_field.append((camera.width / camera.fx_px / 2, camera.height / camera.fy_px / 2))
            focal_px.append(camera.fx_px)
        self.half_field = np.array(half_field).reshape(-1, 2)
        self.focal_px = np.array(focal_px)

    def spans(self, span_s: float) -> list[Indices]:
        """Return the rows of each span of time, counted from midnight, in order."""
        if not len(self.epoch_ns):
            return []
        span = self.epoch_ns // max(round(span_s * 1e9), 1)
        cuts = np.flatnonzero(np.diff(span)) + 1
        return np.split(np.arange(len(span)), cuts)

    def seen(self, spans: list[Indices]) -> NightViews:
        """Return what each row is of."""
        span = np.repeat(np.arange(len(spans)), [len(rows) for rows in spans])
        return NightViews(self.epoch_ns, span, self.tracklet, self.sensor)

    def samples(self, rows: Indices, instants: Indices) -> tuple[Samples, Indices]:
        """Return the tracklets that are seen at some epochs, and which tracklets they are."""
        rows = rows[np.isin(self.epoch_ns[rows], instants)]
        tracklet, item = np.unique(self.tracklet[rows], return_inverse=True)
        at = np.searchsorted(instants, self.epoch_ns[rows])
        t, k = len(tracklet), len(instants)
        seen, u = np.zeros((t, k), bool), np.tile([0.0, 0.0, 1.0], (t, k, 1))
        cov, sigma_km = np.tile(np.eye(2), (t, k, 1, 1)), np.ones((t, k))
        seen[item, at] = True
        u[item, at] = self.u[rows]
        # What all frames share is one draw, however often it is looked at: k looks at it with
        # k times its variance count as one.
        looks = seen.sum(axis=1)[item].astype(float)
        cov[item, at] = self.noise[rows] + looks[:, None, None] * self.bias[rows]
        sigma_km[item, at] = np.sqrt(looks) * self.sigma_km[rows]
        attitude, sensor_km = self._looks(instants)
        sensor_km[self.sensor[rows], at] = self.r_km[rows]
        origin = self.epoch_ns[0]
        return Samples(
            sensor=self.sensor_of_tracklet[tracklet].astype(np.int64),
            start_s=(self.start_ns[tracklet] - origin) / 1e9,
            end_s=(self.end_ns[tracklet] - origin) / 1e9,
            seen=seen,
            u=u,
            cov=cov,
            sigma_km=sigma_km,
            time_s=(instants - origin) / 1e9,
            sensor_km=sensor_km,
            R_sensor_from_icrs=attitude,
            half_field=self.half_field,
        ), tracklet

    def even_instants(self, rows: Indices, window_s: float) -> Indices:
        """Return a few epochs, evenly spaced and far enough apart to be independent.

        Two epochs within twice the half-window share detections.
        """
        epochs = np.unique(self.epoch_ns[rows])
        step = 2 * window_s * 1e9
        n = min(int(max((epochs[-1] - epochs[0]) // step, 1)), MOST_SAMPLES)
        edges = np.linspace(epochs[0], epochs[-1], n + 1)
        middle = (edges[1:] + edges[:-1]) / 2
        return np.unique([epochs[np.argmin(np.abs(epochs - m))] for m in middle])

    def instants(self, rows: Indices, window_s: float) -> Indices:
        """Return a few epochs of a span, so that no tracklet is left out.

        One that none of the evenly spaced epochs shows adds the middle one of its own.
        """
        chosen = set(self.even_instants(rows, window_s).tolist())
        for tracklet in np.unique(self.tracklet[rows]):
            own = self.epoch_ns[rows[self.tracklet[rows] == tracklet]]
            if len(chosen) < MOST_SAMPLES and not chosen.intersection(own.tolist()):
                chosen.add(int(own[len(own) // 2]))
        return np.array(sorted(chosen), np.int64)

    def _looks(self, instants: Indices) -> tuple[Array, Array]:
        """Return how the sensors are turned and where they are; NaN with no frame near."""
        attitude = np.full((len(self.sensors), len(instants), 3, 3), np.nan)
        sensor_km = np.full((len(self.sensors), len(instants), 3), np.nan)
        for s, (frames, turned) in enumerate(self.frames):
            near = np.clip(np.searchsorted(frames.time_ns, instants), 0, len(turned) - 1)
            there = np.abs(frames.time_ns[near] - instants) < NEAR_NS
            attitude[s, there] = turned[near[there]]
            sensor_km[s, there] = frames.r_gcrf_km[near[there]]
        return attitude, sensor_km


def _symmetric(views: pa.Table, pattern: str) -> Array:
    out = np.empty((views.num_rows, 2, 2))
    out[:, 0, 0] = array(views, pattern.format("11"))
    out[:, 0, 1] = out[:, 1, 0] = array(views, pattern.format("12"))
    out[:, 1, 1] = array(views, pattern.format("22"))
    return out
