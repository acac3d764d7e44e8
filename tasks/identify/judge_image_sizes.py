"""Judge image sizes: sensors of which many centroids lie outside the image of their calibration."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import Parts
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Sensor, Span
from epipole.tasks.algorithms.geometry.camera import inside
from epipole.tasks.identify.frame_inputs import flatten_centroids
from epipole.tasks.identify.identify_span import Counts
from epipole.tasks.read.order_frames import frames_between

TOO_MANY = 0.1  # of a sensor's centroids
LOOKED_AT = 100  # frames, from the first one that has centroids outside
EXCHANGED = 0.99  # of the places outside: noise moves a few over another edge


class OutsideImage(NamedTuple):
    """A sensor with more than `TOO_MANY` of its centroids outside an image of this size [px]."""

    sensor_id: str
    share: float  # of the centroids
    width: int
    height: int
    exchanged: bool  # the centroids outside lie in an image of this width as height

    def __str__(self) -> str:
        """Return what was found, in a line for people."""
        hint = " (width and height exchanged?)" if self.exchanged else ""
        return (
            f"{self.sensor_id}: {100 * self.share:.0f} % of its centroids lie outside the image of "
            f"{self.width} x {self.height} px that its calibration tells{hint}"
        )


def judge_image_size(
    frames: ReadFolder,
    sensor: Sensor,
    identified: Parts,
    counts: Sequence[tuple[Span, Counts]],
    cameras: pa.Table,
    settings: Settings,
) -> OutsideImage | None:
    """Return a sensor that has too many centroids outside its image, else None.

    `counts` are those of its spans. Only of such a sensor some frames are read, of the span with
    the most centroids outside.
    """
    outside = sum(count.outside for _, count in counts)
    centroids = sum(count.centroids for _, count in counts)
    if outside <= TOO_MANY * centroids:
        return None
    span, _ = max(counts, key=lambda pair: pair[1].outside)
    exposures = frames_between(frames, sensor.number, *_looked_at(identified, span))
    return _described(sensor.sensor_id, outside / centroids, exposures, cameras, settings)


def _looked_at(identified: Parts, span: Span) -> Span:
    """Return the time of the frames to look at: from the first with centroids outside on."""
    rejects = identified.read(span, "rejects", ["time", "reason"])
    first_ns = array(rejects.filter(pc.field("reason") == Reason.OUTSIDE_IMAGE.value), "time").min()
    time_ns = np.sort(array(identified.read(span, "solutions", ["time"]), "time"))
    last = np.searchsorted(time_ns, first_ns) + LOOKED_AT - 1
    return Span(int(first_ns), int(time_ns[min(last, len(time_ns) - 1)]) + 1)


def _described(
    sensor_id: str, share: float, exposures: pa.Table, cameras: pa.Table, settings: Settings
) -> OutsideImage:
    """Return the image that most centroids outside of these frames lie outside of."""
    c = flatten_centroids(exposures, cameras, settings)
    out = np.flatnonzero(~c.in_image)
    rows = c.camera_of_frame[c.frame[out]]
    row = np.bincount(rows).argmax()
    camera, out = c.cameras[int(row)], out[rows == row]
    turned = camera._replace(width=camera.height, height=camera.width)
    fits = np.mean(inside(turned, c.x_px[out], c.y_px[out]))
    return OutsideImage(sensor_id, share, camera.width, camera.height, bool(fits >= EXCHANGED))
