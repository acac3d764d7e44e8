"""Block views: the views of all sensors in a block of time, window by window.

Only what tells the windows and tracklets apart is held for all views. The rest is read for the
few instants at which tracklets are compared.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array
from epipole.schemas.spans import Span
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.algorithms.association.verdicts import Items
from epipole.tasks.common.equal_runs import group_offsets
from epipole.tasks.solve.association.choose_instants import (
    clear_views,
    even_instants,
    with_extra_instants,
)
from epipole.tasks.solve.association.sensor_poses import SensorPoses

Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

SAMPLED = [
    name
    for name in VIEWS.names
    if name in ("epoch", "ux", "uy", "uz", "x_km", "y_km", "z_km", "position_sigma_km")
    or name.startswith(("w", "cov_"))
]


class SensorViews(NamedTuple):
    """The views of one sensor in a span: VIEWS sorted by tracklet, and tables that go with them.

    `number` and `sensor_id` are the sensor's in the run, `epochs` are SENSOR_EPOCHS, `tracklets`
    are VIEWED_TRACKLETS.
    """

    number: int
    sensor_id: str
    read_views: Callable[[], pa.Table]  # they stay in their file: all views are too many to hold
    epochs: pa.Table
    tracklets: pa.Table


class BlockViews:
    """The views of sensors in a block of time.

    Parameters
    ----------
    sensors
        In the order of their ids.
    block
        Views at other epochs are left out.
    window_s, half_width_s
        Length of a window, and half the time whose detections a view rests on [s].
    """

    def __init__(
        self,
        sensors: Sequence[SensorViews],
        cameras: pa.Table,
        block: Span,
        window_s: float,
        half_width_s: float,
    ) -> None:
        self.sensors, self.half_width_s = list(sensors), half_width_s
        self.sensor_id = np.array([of.sensor_id for of in sensors], str)
        self.tracklets = pa.concat_tables([of.tracklets for of in sensors]).combine_chunks()
        ids = array(self.tracklets, "tracklet_id").astype(str)
        order = np.argsort(ids, kind="stable")
        self.tracklets = self.tracklets.take(order)
        self.tracklet_id = ids[order]
        self.sensor_of_tracklet = np.repeat(
            np.arange(len(sensors)), [of.tracklets.num_rows for of in sensors]
        )[order]
        _, self.track = np.unique(
            array(self.tracklets, "track_id").astype(str), return_inverse=True
        )
        self.start_ns = array(self.tracklets, "start_time")
        self.end_ns = array(self.tracklets, "end_time")
        self.origin_ns = block.start_ns
        self.window_ns = max(round(window_s * 1e9), 1)
        self.poses = SensorPoses([of.epochs for of in sensors], cameras)
        self._place = np.argsort(order, kind="stable")  # of each tracklet, sensor by sensor
        self._read(block)
        self._choose_instants()

    def _read(self, block: Span) -> None:
        """Read the epochs, tracklets and clearness of the views in the block."""
        self._rows, self._epoch_ns, self._tracklet, self._clear = [], [], [], []
        before, parts = 0, []
        for s, of in enumerate(self.sensors):
            views = of.read_views()
            epoch_ns = array(views, "epoch")
            rows = np.flatnonzero(block.holds(epoch_ns))
            n = of.tracklets.num_rows
            local = np.repeat(np.arange(n), array(of.tracklets, "n_views"))[rows]
            tracklet = self._place[before : before + n][local]
            before += n
            self._rows.append(rows)
            self._epoch_ns.append(epoch_ns[rows])
            self._tracklet.append(tracklet)
            self._clear.append(clear_views(views)[rows])
            parts.append(_items(epoch_ns[rows], tracklet, s, self.window_ns))
        window, *columns = (np.concatenate(c).astype(np.int64) for c in zip(*parts, strict=True))
        order = np.lexsort((columns[0], window))
        self.window_number, window = np.unique(window[order], return_inverse=True)
        self.items = Items(window, *(values[order] for values in columns))

    def _choose_instants(self) -> None:
        """Choose the instants of each window at which its tracklets are compared."""
        epochs = np.unique(np.concatenate([np.unique(e) for e in self._epoch_ns]))
        self.epochs = epochs
        self._epoch = [np.searchsorted(epochs, e).astype(np.int32) for e in self._epoch_ns]
        cuts = np.searchsorted(
            epochs // self.window_ns, [*self.window_number, np.iinfo(np.int64).max]
        )
        even = [
            even_instants(epochs[lo:hi], self.half_width_s)
            for lo, hi in itertools.pairwise(cuts.tolist())
        ]
        lacking = self._lacking(np.concatenate([*even, np.zeros(0, np.int64)]))
        self.instants = [
            with_extra_instants(instants, (lacking[w][key] for key in sorted(lacking[w])))
            for w, instants in enumerate(even)
        ]

    def _lacking(self, even: Indices) -> list[dict[int, Indices]]:
        """Return, for each window, the epochs of the clear views of each tracklet that has none
        at the even instants."""
        lacking: list[dict[int, Indices]] = [{} for _ in self.window_number]
        wanted = np.isin(self.epochs, even)
        for epoch_ns, epoch, tracklet, clear in zip(
            self._epoch_ns, self._epoch, self._tracklet, self._clear, strict=True
        ):
            bounds = group_offsets(epoch_ns // self.window_ns, tracklet)
            there = wanted[epoch] & clear
            has = np.add.reduceat(there, bounds[:-1]) > 0 if len(there) else np.zeros(0, bool)
            for k in np.flatnonzero(~has).tolist():
                rows = slice(bounds[k], bounds[k + 1])
                w = np.searchsorted(self.window_number, epoch_ns[bounds[k]] // self.window_ns)
                lacking[w][int(tracklet[bounds[k]])] = epoch_ns[rows][clear[rows]]
        return lacking

    def views_at(self, instants: Indices, items: Indices | None = None) -> tuple[pa.Table, Indices]:
        """Return the clear views at some epochs, and the tracklet of each.

        With `items`, only the views of these items.
        """
        tables, tracklets = [VIEWS.empty_table().select(SAMPLED)], []
        wanted = np.isin(self.epochs, instants)
        key = self._item_key(items) if items is not None else None
        for s, of in enumerate(self.sensors):
            chosen = np.flatnonzero(wanted[self._epoch[s]] & self._clear[s])
            if key is not None:
                chosen = chosen[np.isin(self._view_key(s, chosen), key)]
            tables.append(of.read_views().select(SAMPLED).take(self._rows[s][chosen]))
            tracklets.append(self._tracklet[s][chosen])
        return pa.concat_tables(tables), np.concatenate(tracklets)

    def _item_key(self, items: Indices) -> Indices:
        return self.items.window[items] * len(self.tracklet_id) + self.items.tracklet[items]

    def _view_key(self, sensor: int, rows: Indices) -> Indices:
        window = np.searchsorted(self.window_number, self._epoch_ns[sensor][rows] // self.window_ns)
        return np.asarray(window * len(self.tracklet_id) + self._tracklet[sensor][rows])


def _items(
    epoch_ns: Indices, tracklet: Indices, sensor: int, window_ns: int
) -> tuple[Indices, ...]:
    """Return the columns of ITEMS of one sensor, whose views are sorted by tracklet and epoch."""
    window = epoch_ns // window_ns
    bounds = group_offsets(window, tracklet)
    first, last = bounds[:-1], bounds[1:] - 1
    return (
        window[first],
        tracklet[first],
        np.full(len(first), sensor),
        epoch_ns[first],
        epoch_ns[last],
        np.diff(bounds),
    )
