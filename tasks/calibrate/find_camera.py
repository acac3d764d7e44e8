"""Find the camera of a sensor whose calibration does not fit its stars.

`contradicts_camera` finds these sensors: few frames are identified, or stars lie far from their
predicted positions, or all stars are in one part of the image. `find_sensor_cameras` then searches
three frames for focal length, direction of the rows and distortion (`camera_search`); another frame
has to agree. A `CameraFinding` says what differs from the log's calibration.
"""

import logging
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.io.work.parts import Parts
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.arrays import Array, Indices
from epipole.schemas.bridge import array, concat, flatten, rows_with
from epipole.schemas.settings import IdentificationSettings, SensorSettings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import STARS
from epipole.schemas.work_tables import CAMERAS, EXPOSURES
from epipole.tasks.algorithms.constants import DAY_NS, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.algorithms.star_identification.camera_search import (
    MIN_CENTROIDS,
    FoundCamera,
    ImageFrame,
    agreeing_camera,
    find_cameras,
)
from epipole.tasks.algorithms.star_identification.centroids import brightest_first
from epipole.tasks.algorithms.star_identification.search_budget import SearchBudget
from epipole.tasks.algorithms.star_identification.sensor_model import Skies
from epipole.tasks.calibrate.calibrate_sensors import SensorStars, with_optics
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.sightings import camera_of
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue
from epipole.tasks.identify.frame_inputs import flatten_centroids, interpolate_sensor_states
from epipole.tasks.identify.identify_span import states_about
from epipole.tasks.identify.identify_stars import match_settings
from epipole.tasks.identify.tabulate import barycentric_velocity
from epipole.tasks.read.order_frames import frames_between

LOGGER = logging.getLogger(__name__)

# The camera is searched for if at most the first share of the frames was identified. If no camera
# is found, a warning says so only if at most the second share was.
MAX_IDENTIFIED, MAX_IDENTIFIED_TO_WARN = 0.5, 0.05
# With right optics, a frame's stars are all over the image: their variance is that of an even
# distribution, 1/12 per axis in units of the image's sides. With strong distortion, dense clusters
# of stars match alone: the variance is below this share of it.
CLUSTERED_VARIANCE = 0.1
# With wrong optics, stars lie farther from their predicted positions than any sensor's centroids do
# [px], and more than this share of the centroids is unmatched.
LARGE_RESIDUAL_PX, MANY_UNMATCHED = 1.0, 0.2
REACH = 1.11  # focal lengths from 10 % shorter to 11 % longer than the nominal one are tried
TRIED = 3  # frames in which a camera is searched for
# What the search may cost before it takes another frame, as part of what all searches of the
# sensor's frames may. A frame with few stars in a crowd costs 4 s: 128 sensors that see 400 frames
# of such took half of the CPU time of their night.
COST_SHARE = 0.2
RICH = 0.75  # quantile of the number of centroids, of the frames that are tried


class CameraFinding(NamedTuple):
    """The camera of a sensor whose frames contradict its calibration.

    logged : the camera of the log
    camera : the one found, None without one
    """

    sensor_id: str
    logged: Camera
    camera: Camera | None

    @property
    def nominal(self) -> Camera:
        """The camera of the log, mirrored where the image is."""
        upward = self.camera is not None and self.camera.fy_px < 0
        return mirrored(self.logged) if upward != (self.logged.fy_px < 0) else self.logged

    def cameras(self, nominal: pa.Table, camera: Camera) -> pa.Table:
        """Return the sensor's rows of CAMERAS with this camera."""
        of_sensor = rows_with(nominal, "sensor_id", self.sensor_id)
        return with_optics(of_sensor, dict.fromkeys(range(of_sensor.num_rows), camera._asdict()))

    def __str__(self) -> str:
        """Return what was found, in a line for people."""
        name, camera = self.sensor_id, self.camera
        if camera is None:
            return (
                f"{name}: no search finds stars in its frames, with focal lengths 10 % shorter to "
                "11 % longer than logged, with distortion and with rows counted upward either"
            )
        parts = []
        if (camera.fy_px < 0) != (self.logged.fy_px < 0):
            parts.append("the image is mirrored (y up?)")
        moved_px = (camera.k1 - self.logged.k1) * camera.fx_px * camera.corner_distance**3
        if abs(moved_px) >= 1.0:
            parts.append(
                f"distortion moves its corners by some {abs(moved_px):.0f} px more than logged "
                f"(k1 about {camera.k1:.2g}, not {self.logged.k1:.2g})"
            )
        percent = 100 * (camera.fx_px / self.logged.fx_px - 1)
        if abs(percent) >= 0.1:
            size = "longer" if percent > 0 else "shorter"
            parts.append(
                f"the focal length is {abs(percent):.1f} % {size} than logged "
                f"({camera.fx_px:.1f} px, not {self.logged.fx_px:.1f})"
            )
        return f"{name}: {' and '.join(parts) or 'its stars were found in a second search'}"


def contradicts_camera(
    sensor: Sensor, spans: Sequence[Span], identified: Parts, cameras: pa.Table
) -> bool:
    """Return whether a sensor's stars contradict its camera.

    Few of the frames with enough centroids were identified, or stars are far from their predicted
    positions, or all in one part of the image.
    """
    rows = _solutions(identified, spans)
    tried = pc.sum(pc.greater_equal(rows["n_centroids"], MIN_CENTROIDS)).as_py() or 0
    solved = rows_with(rows, "attitude_source", "stars")
    camera = _only_camera(cameras, sensor.sensor_id)
    if (tried > 0 and solved.num_rows <= MAX_IDENTIFIED * tried) or residuals_are_large(solved):
        return True
    return camera is not None and stars_are_clustered(_stars(identified, spans), camera)


def residuals_are_large(solved: pa.Table) -> bool:
    """Return whether stars of identified frames lie far from their predicted positions, and many
    centroids are unmatched."""
    if not solved.num_rows:
        return False
    star_share = array(solved, "n_stars") / array(solved, "n_centroids")
    return bool(np.median(array(solved, "residual_px")) > LARGE_RESIDUAL_PX) and bool(
        np.median(star_share) < 1 - MANY_UNMATCHED
    )


def stars_are_clustered(stars: pa.Table, camera: Camera) -> bool:
    """Return whether all stars of the typical frame are in one part of the image."""
    frame = array(stars, "frame_number")
    starts = np.flatnonzero(np.diff(frame, prepend=frame[:1] - 1))
    n = np.diff(np.append(starts, len(frame)))
    if not np.any(n > 1):
        return False
    of_frame = np.repeat(np.arange(len(n)), n)
    variance = np.zeros(len(n))
    for name, side in (("x_px", camera.width), ("y_px", camera.height)):
        position = array(stars, name) / side
        off = position - (np.add.reduceat(position, starts) / n)[of_frame]
        variance += np.add.reduceat(off**2, starts) / np.maximum(n - 1, 1)
    return bool(np.median(variance[n > 1]) < CLUSTERED_VARIANCE * 2 / 12)


def _stars(identified: Parts, spans: Sequence[Span]) -> pa.Table:
    """Return the stars of the first span that has any: one part is enough."""
    columns = ["frame_number", "x_px", "y_px"]
    for span in spans:
        stars = identified.read(span, "stars", columns)
        if stars.num_rows:
            return stars
    return STARS.empty_table().select(columns)


def _solutions(identified: Parts, spans: Sequence[Span]) -> pa.Table:
    columns = ["time", "n_centroids", "n_stars", "attitude_source", "residual_px"]
    return pa.concat_tables([identified.read(span, "solutions", columns) for span in spans])


@stage_task(Stage.CALIBRATE, "{stars}")
def find_sensor_cameras(
    frames: ReadFolder,
    stars: Batch[SensorStars],
    cameras: pa.Table,
    sensors: SensorSettings,
    identification: IdentificationSettings,
) -> list[CameraFinding]:
    """Return what can be found of the cameras of those sensors whose stars contradict them.

    Left out is a sensor that has several calibrations or too few centroids, or that identifies
    some frames with its nominal camera if no other camera matches clearly more stars.
    """
    findings = [
        _find_sensor_camera(frames, *each, cameras, sensors, identification)
        for each in stars
        if contradicts_camera(*each, cameras)
    ]
    return [finding for finding in findings if finding is not None]


def _find_sensor_camera(
    frames: ReadFolder,
    sensor: Sensor,
    spans: Sequence[Span],
    identified: Parts,
    cameras: pa.Table,
    sensors: SensorSettings,
    identification: IdentificationSettings,
) -> CameraFinding | None:
    camera = _only_camera(cameras, sensor.sensor_id)
    tried = _solutions(identified, spans).filter(pc.field("n_centroids") >= MIN_CENTROIDS)
    solved = rows_with(tried, "attitude_source", "stars")
    some = solved.num_rows > MAX_IDENTIFIED_TO_WARN * tried.num_rows
    tried = solved if some else tried  # the others may show the Earth
    if camera is None:
        LOGGER.warning(
            "%s: its stars contradict its calibration; no other is searched for, because the log "
            "has several", sensor.sensor_id,
        )  # fmt: skip
    if camera is None or not tried.num_rows:
        return None
    budget_s = COST_SHARE * SearchBudget(tried.num_rows, identification.time_limit_s).total_s
    tried = tried.take(rich_frames(array(tried, "n_centroids")))
    images = [
        image._replace(n_stars=n_stars)
        for t, n_stars in zip(array(tried, "time"), array(tried, "n_stars"), strict=True)
        for image in image_frames(*_frame_with_state(frames, sensor, int(t), sensors), sensors)
    ]
    skies_of = skies_at(int(array(tried, "time")[0]), identification)
    found = find_agreed_camera(images, camera, REACH, skies_of, identification, budget_s)
    if found is None and some:
        return None
    return CameraFinding(sensor.sensor_id, camera, found and found.camera)


def rich_frames(n_centroids: Array) -> Indices:
    """Return the rows of `TRIED` frames with many centroids, one of each part of the night.

    The middle part comes first. The frame with most centroids is not taken: these may be clutter.
    n_centroids : (n,), of at least one frame, in order of time
    """
    parts = np.array_split(np.arange(len(n_centroids)), min(TRIED, len(n_centroids)))
    rows = []
    for part in parts:
        rank = np.argsort(n_centroids[part], kind="stable")
        rows.append(part[rank[round(RICH * (len(part) - 1))]])
    return np.roll(np.array(rows, np.int64), -(len(rows) // 2))


def find_agreed_camera(
    frames: Sequence[ImageFrame],
    nominal: Camera,
    reach: float,
    skies_of: Callable[[float], Skies],
    identification: IdentificationSettings,
    budget_s: float = math.inf,
) -> FoundCamera | None:
    """Return the first camera of a frame that another frame agrees with; or that of the only
    frame. `budget_s` as in `find_cameras`."""
    matching = match_settings(identification)
    for found in find_cameras(frames, nominal, reach, skies_of, matching, budget_s):
        others = [frame for k, frame in enumerate(frames) if k != found.frame]
        if not others or any(
            agreeing_camera(frame, found.camera, skies_of, matching) for frame in others
        ):
            return found
    return None


def skies_at(time_ns: int, rule: IdentificationSettings) -> Callable[[float], Skies]:
    """Return the skies of a day, by the angle of a pixel."""
    catalogue = Catalogue(read_star_catalogue(rule.catalogue))
    return lambda pixel_rad: CachedSkies(catalogue, time_ns // DAY_NS, pixel_rad, rule.merge_px)


def image_frames(
    exposures: pa.Table, frame_states: pa.Table, sensors: SensorSettings
) -> list[ImageFrame]:
    """Return the centroids of each frame, brightest first, each position once.

    `frame_states` are SENSOR_STATES_AT_FRAMES of `exposures`.
    """
    x_px, first = flatten(exposures, "x_px")
    c = flatten_centroids(exposures, CAMERAS.empty_table(), sensors)
    at = brightest_first(first, c.flux)
    beta = barycentric_velocity(array(exposures, "time"), frame_states) / SPEED_OF_LIGHT_KM_S
    frames = []
    for k in range(exposures.num_rows):
        rows = at[first[k] : first[k + 1]]
        rows = rows[~c.repeated[rows]]
        magnitude = -2.5 * np.log10(c.flux[rows])
        frames.append(ImageFrame(x_px[rows], c.y_px[rows], c.sigma_px[rows], magnitude, beta[k]))
    return frames


def _frame_with_state(
    frames: ReadFolder, sensor: Sensor, time_ns: int, sensors: SensorSettings
) -> tuple[pa.Table, pa.Table]:
    """Return EXPOSURES of one frame, and its SENSOR_STATES_AT_FRAMES."""
    instant = Span(time_ns, time_ns + 1)
    exposures = concat(EXPOSURES, [frames_between(frames, sensor.number, *instant)])
    return exposures, interpolate_sensor_states(
        exposures, states_about(frames, sensor, instant, sensors.state_gap_s), sensors
    )


def _only_camera(cameras: pa.Table, sensor_id: str) -> Camera | None:
    """Return the camera of a sensor, None if it has several or none."""
    rows = rows_with(cameras, "sensor_id", sensor_id)
    different = {camera_of(rows, k) for k in range(rows.num_rows)}
    return different.pop() if len(different) == 1 else None
