"""Stage `calibrate`: which sensors are searched for their cameras, and whose optics are fitted.

Each sensor is a task; those whose optics change are identified again.
"""

import logging
from collections.abc import Iterable, Sequence

import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.night.progress import flat, results
from epipole.flows.night.stages import identify_all
from epipole.flows.night.work import Work
from epipole.schemas.bridge import concat
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Sensor
from epipole.schemas.stages import Stage
from epipole.schemas.tables import CALIBRATIONS
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.calibrate.calibrate_sensors import Calibrated, SensorStars, calibrate_each
from epipole.tasks.calibrate.find_camera import (
    CameraFinding,
    find_sensor_cameras,
)

LOGGER = logging.getLogger(__name__)

# Maximum number of rounds. Better optics identify more stars, and these improve the optics. Two
# rounds are enough, except for a sensor that was hardly identified before.
MAX_CALIBRATIONS = 4


def find_cameras(work: Work, settings: Settings) -> tuple[Work, pa.Table]:
    """Search for the cameras of sensors whose stars contradict them; identify these again.

    Returns
    -------
    work
        With the cameras that were found.
    stated
        CAMERAS as the log states them, but mirrored where the images are mirrored.
    """
    mode = settings.identification.calibrate
    if mode == "off":
        return work, work.cameras
    futures = [
        find_sensor_cameras.submit(
            work.frames, batch, work.cameras, settings.sensors, settings.identification
        )
        for batch in work.sensor_batches(stars_of(work, work.spans))
    ]
    findings: list[CameraFinding] = flat(results(Stage.CALIBRATE, futures))
    for finding in findings:
        used = "" if finding.camera is None else "; used" if mode == "use" else "; not used"
        LOGGER.warning("%s%s", finding, used)
    found = [finding for finding in findings if finding.camera is not None]
    if mode == "report" or not found:
        return work, work.cameras
    names = {finding.sensor_id for finding in found}
    stated = _with_cameras(work.cameras, [f.cameras(work.cameras, f.nominal) for f in found], names)
    cameras = [f.cameras(work.cameras, f.camera) for f in found if f.camera]
    return _identify_again(work, cameras, names, 0, settings), stated


def calibrate(work: Work, stated: pa.Table, settings: Settings) -> tuple[Work, pa.Table]:
    """Fit each sensor's optics to its stars; identify again the sensors whose optics differ.

    `stated` are the cameras of `find_cameras`. Optics with which a sensor has at most half as many
    identified frames as before were fitted to wrong stars: they are neither used nor reported.
    """
    mode = settings.identification.calibrate
    calibrations, misled = CALIBRATIONS.empty_table(), set[str]()
    for number in range(1, 1 + {"off": 0, "report": 1, "use": MAX_CALIBRATIONS}[mode]):
        fits = _fit_sensors(work, stated, misled, settings)
        calibrations = concat(CALIBRATIONS, [fit.calibrations for fit in fits])
        departed = {name for fit in fits for name in fit.departed}
        if mode == "report" or not departed:
            break
        LOGGER.info("optics of %s differ from the calibration", ", ".join(sorted(departed)))
        again = _identify_again(work, [fit.cameras for fit in fits if fit.departed], departed,
                                number, settings)  # fmt: skip
        lost = {sensor for sensor in work.spans if sensor.sensor_id in departed
                and 2 * _n_solved(again, sensor) <= _n_solved(work, sensor)}  # fmt: skip
        work = _as_before(again, work, lost)
        misled |= {sensor.sensor_id for sensor in lost}
    return work, calibrations.filter(
        pc.invert(pc.is_in(calibrations["sensor_id"], pa.array(sorted(misled), pa.string())))
    )


def _fit_sensors(
    work: Work, stated: pa.Table, excluded: set[str], settings: Settings
) -> list[Calibrated]:
    """Fit the optics of each sensor to its stars, except those excluded."""
    sensors = [sensor for sensor in work.spans if sensor.sensor_id not in excluded]
    futures = [
        calibrate_each.submit(
            batch, work.cameras, stated, settings.sensors.principal_point_sigma_px
        )
        for batch in work.sensor_batches(stars_of(work, sensors))
    ]
    fits: list[Calibrated] = flat(results(Stage.CALIBRATE, futures))
    return fits


def stars_of(work: Work, sensors: Iterable[Sensor]) -> list[SensorStars]:
    """Return where the identified stars of these sensors are."""
    return [SensorStars(sensor, work.spans[sensor], work.identified[sensor]) for sensor in sensors]


def _n_solved(work: Work, sensor: Sensor) -> int:
    """Return how many of a sensor's frames have an attitude from stars."""
    parts = work.identified[sensor]
    sources = [
        parts.read(span, "solutions", ["attitude_source"])["attitude_source"]
        for span in work.spans[sensor]
    ]
    return sum(pc.sum(pc.equal(source, "stars")).as_py() or 0 for source in sources)


def _as_before(work: Work, before: Work, sensors: set[Sensor]) -> Work:
    """Return the work with the cameras and identified frames that these sensors had before."""
    if not sensors:
        return work
    names = {sensor.sensor_id for sensor in sensors}
    LOGGER.warning(
        "optics fitted to the stars of %s identify hardly any frames; not used",
        ", ".join(sorted(names)),
    )
    earlier = before.cameras.filter(
        pc.is_in(before.cameras["sensor_id"], pa.array(sorted(names), pa.string()))
    )
    return work._replace(
        cameras=_with_cameras(work.cameras, [earlier], names),
        identified={**work.identified, **{s: before.identified[s] for s in sensors}},
    )


def _identify_again(
    work: Work,
    fitted: Sequence[pa.Table],
    departed: set[str],
    number: int,
    settings: Settings,
) -> Work:
    """Identify again, with the fitted optics, the sensors whose optics differ."""
    cameras = _with_cameras(work.cameras, fitted, departed)
    spans = {sensor: of_sensor for sensor, of_sensor in work.spans.items()
             if sensor.sensor_id in departed}  # fmt: skip
    where = {sensor: work.folder.identified_again(sensor, number) for sensor in spans}
    departed_work = work._replace(cameras=cameras, spans=spans, identified=where)
    identify_all(Stage.CALIBRATE, departed_work, settings)
    return work._replace(cameras=cameras, identified={**work.identified, **where})


def _with_cameras(cameras: pa.Table, others: Sequence[pa.Table], sensors: set[str]) -> pa.Table:
    """Return CAMERAS with other rows for these sensors, sorted."""
    unchanged = cameras.filter(pc.invert(pc.is_in(cameras["sensor_id"], pa.array(sorted(sensors)))))
    return concat(CAMERAS, [unchanged, *others]).sort_by(
        [("sensor_id", "ascending"), ("time", "ascending")]
    )
