"""Calibrate a camera about which little is known, from a few frames of one sensor.

The camera is searched for in some frames (`find_camera`), then fitted to the stars of all.
"""

from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.schemas.bridge import array, flatten, table, unstack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.algorithms.star_identification.camera_search import MIN_CENTROIDS
from epipole.tasks.calibrate.calibrate_sensors import Calibrated, calibrate_sensors
from epipole.tasks.calibrate.find_camera import find_agreed_camera, image_frames, skies_at
from epipole.tasks.common.sightings import camera_of
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states
from epipole.tasks.identify.identify_stars import identify_stars

TRIED = 6  # frames in which the camera is searched for
REACH = 1.5  # factor by which a stated focal length may be off, either way
MIN_FIELD_DEG, MAX_FIELD_DEG = 2.0, 60.0  # that are tried if the field is unknown
# The fit starts from a focal length that differs by this factor from the one found, as from a wrong
# calibration: so optics are fitted in steps.
OFF_NOMINAL = 1.001
ROUNDS = 3  # of identification and fit: with better optics more stars take part


class CameraReport(NamedTuple):
    """What is known of a sensor's camera after calibration.

    nominal : the camera of the log; a guess unless `has_calibration`
    reach : factor by which focal lengths around the nominal one were tried
    has_image_size : the size of the image is that of the log
    camera : the one found, None where the frames show no stars
    sigma : by the names of the optics; empty with too few stars for a fit
    n_frames, n_identified, n_stars : frames looked at, identified, and their stars
    residual_px : rms of the stars' residuals per axis, NaN without a fit
    """

    sensor_id: str
    nominal: Camera
    reach: float
    has_calibration: bool
    has_image_size: bool
    camera: Camera | None
    sigma: dict[str, float]
    n_frames: int
    n_identified: int
    n_stars: int
    residual_px: float

    @property
    def is_mirrored(self) -> bool:
        """Whether the rows count the other way than in the nominal camera."""
        return self.camera is not None and (self.camera.fy_px < 0) != (self.nominal.fy_px < 0)


def calibrate_unknown(
    exposures: pa.Table,
    states: pa.Table,
    cameras: pa.Table,
    field_deg: float | None,
    settings: Settings,
) -> CameraReport:
    """Return one sensor's camera from some of its frames.

    Parameters
    ----------
    exposures, states
        EXPOSURES and SENSOR_STATES of the sensor, sorted by time; at least one frame.
    cameras
        CAMERAS of the sensor; of several rows the first is used. It may be empty.
    field_deg
        Field of view along the columns, about; None: as the calibration says, else unknown.
    """
    sensor_id = exposures["sensor_id"][0].as_py()
    nominal, reach = _start(exposures, cameras, field_deg)
    frame_states = interpolate_sensor_states(exposures, states, settings.sensors)
    found = _search(exposures, frame_states, nominal, reach, settings)
    has_calibration = cameras.num_rows > 0 and field_deg is None
    nothing = CameraReport(
        sensor_id, nominal, reach, has_calibration, cameras.num_rows > 0, None, {},
        exposures.num_rows, 0, 0, np.nan,
    )  # fmt: skip
    if found is None:
        return nothing
    start = nothing._replace(camera=found)
    return _fitted(start, exposures, frame_states, settings)


def _start(exposures: pa.Table, cameras: pa.Table, field_deg: float | None) -> tuple[Camera, float]:
    """Return the camera to start from, and by which factor its focal length may be off."""
    if cameras.num_rows:
        camera = camera_of(cameras, 0)
        if field_deg is None:
            return camera, REACH
        camera = camera._replace(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, fisheye=False)
    else:
        width, height = (_side_px(exposures, name) for name in ("x_px", "y_px"))
        camera = Camera(width, height, 1.0, 1.0, (width - 1) / 2, (height - 1) / 2)
    narrow, wide = np.tan(np.radians([MIN_FIELD_DEG, MAX_FIELD_DEG]) / 2)
    half = np.sqrt(narrow * wide) if field_deg is None else np.tan(np.radians(field_deg) / 2)
    f = float(camera.width / 2 / half)
    reach = float(np.sqrt(wide / narrow)) if field_deg is None else REACH
    return camera._replace(fx_px=f, fy_px=f * np.sign(camera.fy_px)), reach


def _side_px(exposures: pa.Table, name: str) -> int:
    """Return a side of the image, as far as centroids reach, in whole multiples of 8."""
    farthest = np.nanmax(flatten(exposures, name)[0], initial=0.0)
    return max(8 * int(np.ceil((farthest + 0.5) / 8)), 8)


def _search(
    exposures: pa.Table, frame_states: pa.Table, nominal: Camera, reach: float, settings: Settings
) -> Camera | None:
    counts = np.diff(flatten(exposures, "x_px")[1])
    rows = np.flatnonzero(counts >= MIN_CENTROIDS)
    if not len(rows):
        return None
    # Not those with most centroids: these may be mostly clutter.
    rows = rows[np.argsort(np.abs(counts[rows] - np.median(counts[rows])), kind="stable")]
    rows = np.sort(rows[:TRIED])
    images = image_frames(exposures.take(rows), frame_states.take(rows), settings.sensors)
    skies = skies_at(int(array(exposures, "time")[rows[0]]), settings.identification)
    found = find_agreed_camera(images, nominal, reach, skies, settings.identification)
    return found and found.camera


def _as_table(report: CameraReport, camera: Camera) -> pa.Table:
    """Return CAMERAS of the sensor, as if its log had this camera."""
    key = {"sensor_id": [report.sensor_id], "time": [0]}
    values = {name: [value] for name, value in camera._asdict().items()}
    cov = unstack_covariance("cov_{}", np.zeros((1, 9, 9)), OPTICS_AXES)
    return table(CAMERAS, key | values | cov)


def _given(report: CameraReport) -> Camera:
    """Return the camera that the fit starts from: the nominal one, or one near the camera found."""
    if report.has_calibration:
        return mirrored(report.nominal) if report.is_mirrored else report.nominal
    assert report.camera is not None
    f = report.camera.fx_px * OFF_NOMINAL
    return report.camera._replace(fx_px=f, fy_px=f * np.sign(report.camera.fy_px))


def _fitted(
    report: CameraReport, exposures: pa.Table, frame_states: pa.Table, settings: Settings
) -> CameraReport:
    """Return the report with the camera fitted to the stars of all frames."""
    catalogue = read_star_catalogue(settings.identification.catalogue)
    assert report.camera is not None
    cameras, nominal = _as_table(report, report.camera), _as_table(report, _given(report))
    for _ in range(ROUNDS):
        identified = identify_stars(
            exposures, frame_states, cameras, catalogue, settings.sensors,
            settings.identification, settings.tracklets.max_detections,
        )  # fmt: skip
        fit: Calibrated = calibrate_sensors(
            identified.stars, cameras, nominal, settings.sensors.principal_point_sigma_px
        )
        cameras = fit.cameras
        if not fit.departed:
            break
    camera = camera_of(cameras, 0)
    solved = pc.sum(pc.equal(identified.solutions["attitude_source"], "stars")).as_py()
    report = report._replace(camera=camera, n_identified=solved, n_stars=identified.stars.num_rows)
    if not fit.calibrations.num_rows:
        return report
    values: dict[str, Any] = fit.calibrations.to_pylist()[0]
    sigma = {name[6:]: value for name, value in values.items() if name.startswith("sigma_")}
    return report._replace(sigma=sigma, residual_px=values["residual_px"])
