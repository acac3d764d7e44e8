"""Find a camera: focal length and handedness of a sensor that its calibration does not fit."""

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.io.work.parts import Parts
from epipole.io.work.places import ReadFolder
from epipole.schemas.bridge import array, concat, flatten
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import CAMERAS, EXPOSURES
from epipole.tasks.algorithms.constants import DAY_NS, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.algorithms.star_identification.camera_search import (
    FEWEST,
    FoundCamera,
    ImageFrame,
    agrees,
    find_camera,
)
from epipole.tasks.algorithms.star_identification.frames.spots import brightest_first
from epipole.tasks.algorithms.star_identification.sensor import Skies, spread
from epipole.tasks.calibrate.calibrate_sensors import with_optics
from epipole.tasks.common.sightings import camera_of
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue
from epipole.tasks.identify.flatten_centroids import flatten_centroids
from epipole.tasks.identify.identify_span import states_about
from epipole.tasks.identify.identify_stars import search_of
from epipole.tasks.identify.place_sensors import place_sensors
from epipole.tasks.identify.tabulate_identified import barycentric_velocity
from epipole.tasks.read.order_frames import frames_between

LOGGER = logging.getLogger(__name__)

# Of a sensor that identifies no more of its frames than this, the camera is searched for.
REFUSES = 0.05
REACH = 1.11  # in a run: focal lengths from 10 % shorter to 11 % longer than told
TRIED = 3  # frames


class CameraFinding(NamedTuple):
    """The camera of a sensor that refuses everything.

    `camera` is None where none was found; `told` is that of the log.
    """

    sensor_id: str
    told: Camera
    camera: Camera | None

    @property
    def as_told(self) -> Camera:
        """The camera that the log tells, mirrored where the image is."""
        upward = self.camera is not None and self.camera.fy_px < 0
        return mirrored(self.told) if upward != (self.told.fy_px < 0) else self.told

    def cameras(self, told: pa.Table, camera: Camera) -> pa.Table:
        """Return the sensor's rows of CAMERAS with this camera."""
        of_sensor = told.filter(pc.field("sensor_id") == self.sensor_id)
        return with_optics(of_sensor, {self.sensor_id: camera._asdict()})

    def __str__(self) -> str:
        """Return what was found, in a line for people."""
        name, camera = self.sensor_id, self.camera
        if camera is None:
            return (
                f"{name}: its frames show no stars, with focal lengths 10 % shorter to 11 % longer "
                "than told and with rows counted upward either"
            )
        parts = []
        if (camera.fy_px < 0) != (self.told.fy_px < 0):
            parts.append("the image is mirrored (y up?)")
        percent = 100 * (camera.fx_px / self.told.fx_px - 1)
        if abs(percent) >= 0.1:
            size = "longer" if percent > 0 else "shorter"
            parts.append(
                f"the focal length is {abs(percent):.1f} % {size} than told "
                f"({camera.fx_px:.1f} px, not {self.told.fx_px:.1f})"
            )
        return f"{name}: {' and '.join(parts) or 'its stars were found in a second search'}"


def refuses(identified: Parts, spans: Sequence[Span]) -> bool:
    """Return whether hardly any frame of a sensor could be identified that has enough centroids."""
    rows = _solutions(identified, spans)
    tried = pc.sum(pc.greater_equal(rows["n_centroids"], FEWEST)).as_py() or 0
    solved = pc.sum(pc.equal(rows["attitude_source"], "stars")).as_py() or 0
    return tried > 0 and solved <= REFUSES * tried


def _solutions(identified: Parts, spans: Sequence[Span]) -> pa.Table:
    columns = ["time", "n_centroids", "attitude_source"]
    return pa.concat_tables([identified.read(span, "solutions", columns) for span in spans])


@stage_task(Stage.CALIBRATE, "{sensor}")
def find_sensor_camera(
    frames: ReadFolder,
    sensor: Sensor,
    identified: Parts,
    spans: Sequence[Span],
    cameras: pa.Table,
    settings: Settings,
) -> CameraFinding | None:
    """Return what can be found of the camera of a sensor that `refuses` its frames.

    None for one with several calibrations.
    """
    camera = _only_camera(cameras, sensor.sensor_id)
    if camera is None:
        return None
    tried = _solutions(identified, spans).filter(pc.field("n_centroids") >= FEWEST)
    rows = spread(tried.num_rows, TRIED)
    times = array(tried, "time")[np.roll(rows, -(len(rows) // 2))]  # first from the middle
    parts = [image_frames(*_placed(frames, sensor, int(t), settings), settings) for t in times]
    images = [frame for part in parts for frame in part]
    found = find_agreed_camera(images, camera, REACH, skies_at(int(times[0]), settings), settings)
    return CameraFinding(sensor.sensor_id, camera, found and found.camera)


def find_agreed_camera(
    frames: Sequence[ImageFrame],
    told: Camera,
    reach: float,
    skies_of: Callable[[float], Skies],
    settings: Settings,
) -> FoundCamera | None:
    """Return the camera of the first frame that shows stars, if another frame agrees.

    A single frame needs no other.
    """
    how = search_of(settings)
    found = find_camera(frames, told, reach, skies_of, how)
    if found is None:
        return None
    others = [frame for k, frame in enumerate(frames) if k != found.frame]
    if others and not any(agrees(frame, found.camera, skies_of, how) for frame in others):
        return None
    return found


def skies_at(time_ns: int, settings: Settings) -> Callable[[float], Skies]:
    """Return the skies of a day, by the angle of a pixel."""
    rule = settings.identification
    catalogue = Catalogue(read_star_catalogue(rule.catalogue))
    return lambda pixel_rad: CachedSkies(catalogue, time_ns // DAY_NS, pixel_rad, rule.merge_px)


def image_frames(exposures: pa.Table, places: pa.Table, settings: Settings) -> list[ImageFrame]:
    """Return the centroids of each frame, brightest first; `places` are PLACES of `exposures`."""
    x_px, first = flatten(exposures, "x_px")
    c = flatten_centroids(exposures, CAMERAS.empty_table(), settings)
    at = brightest_first(first, c.flux)
    magnitude = -2.5 * np.log10(c.flux[at])
    beta = barycentric_velocity(array(exposures, "time"), places) / SPEED_OF_LIGHT_KM_S
    x, y, sigma_px = x_px[at], c.y_px[at], c.sigma_px[at]
    frames = []
    for k in range(exposures.num_rows):
        of_frame = slice(first[k], first[k + 1])
        frames.append(
            ImageFrame(x[of_frame], y[of_frame], sigma_px[of_frame], magnitude[of_frame], beta[k])
        )
    return frames


def _placed(
    frames: ReadFolder, sensor: Sensor, time_ns: int, settings: Settings
) -> tuple[pa.Table, pa.Table]:
    """Return EXPOSURES of one frame, and its PLACES."""
    instant = Span(time_ns, time_ns + 1)
    exposures = concat(EXPOSURES, [frames_between(frames, sensor.number, *instant)])
    return exposures, place_sensors(
        exposures, states_about(frames, sensor, instant, settings), settings
    )


def _only_camera(cameras: pa.Table, sensor_id: str) -> Camera | None:
    """Return the camera of a sensor, None where it has several."""
    rows = cameras.filter(pc.field("sensor_id") == sensor_id)
    different = {camera_of(rows, k) for k in range(rows.num_rows)}
    return different.pop() if len(different) == 1 else None
