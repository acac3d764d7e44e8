"""Calibrate the cameras of logs: what to write into a log whose calibration is missing or wrong."""

import json
import math
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.night.log_choice import find_logs
from epipole.flows.night.summary import many
from epipole.io.caches.private_folders import temporary_folder
from epipole.io.logs.messages.cameras import PINHOLE_TERMS
from epipole.io.logs.writer import distortion_of
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array, concat
from epipole.schemas.errors import LogError
from epipole.schemas.settings import Settings
from epipole.schemas.spans import ALL_TIME
from epipole.schemas.work_tables import EXPOSURES
from epipole.tasks.algorithms.star_identification.sensor_model import evenly_spaced
from epipole.tasks.calibrate.calibrate_unknown import (
    CameraReport,
    calibrate_unknown,
)
from epipole.tasks.common.sightings import calibration_at
from epipole.tasks.read.order_frames import (
    OrderedFrames,
    frame_times,
    frames_between,
    order_logs,
    states_between,
)
from epipole.tasks.read.read_logs import read_log_into

MOST_CORNER_PX = 1.0  # 1-sigma of a term, at the corner: the stars do not show a larger one
MAX_FRAMES = 100  # of a sensor, spread over the logs


def calibrate(
    logs: list[str],
    field_deg: float | None = None,
    settings: Settings = Settings(),  # noqa: B008
) -> list[CameraReport]:
    """Return the camera of each sensor of the logs, from at most 100 of its frames.

    Of a sensor with several calibrations it is that of its last frame, and of the others for which
    this one's calibration holds.

    Parameters
    ----------
    logs
        MCAP files, folders, globs or URLs of them.
    field_deg
        Field of view along the columns, about, of all sensors. None: as the logs' calibrations
        say, and unknown for a sensor without one.
    settings
        Those of a run; logs are read as `sensors.assume` says.

    Raises
    ------
    LogError
        Where a file that is named is not a log, or the logs have no frames.
    """
    paths = find_logs(logs, None).paths
    with temporary_folder("calibrate") as made:
        folder = ReadFolder(made)
        read = [
            read_log_into(folder, k, path, settings.sensors.assume) for k, path in enumerate(paths)
        ]
        frames = order_logs(folder, read, settings.sensors)
        numbers = [k for k, spans in enumerate(frames.spans) if spans]
        if not numbers:
            raise LogError(f"{', '.join(paths)}: no frames in these logs; check the recording")
        return [_of_sensor(frames, number, field_deg, settings) for number in numbers]


def _of_sensor(
    frames: OrderedFrames, number: int, field_deg: float | None, settings: Settings
) -> CameraReport:
    time_ns = frame_times(frames.folder, number)
    cameras = frames.cameras.filter(pc.field("sensor_id") == frames.sensors[number])
    newest = int(calibration_at(array(cameras, "time"), time_ns[-1:])[0])
    if newest > 0:
        cameras = cameras.slice(newest, 1)
        time_ns = time_ns[time_ns >= array(cameras, "time")[0]]
    rows = evenly_spaced(len(time_ns), MAX_FRAMES)
    parts = [frames_between(frames.folder, number, t, t + 1) for t in time_ns[rows].tolist()]
    exposures: pa.Table = concat(EXPOSURES, parts).combine_chunks()
    states = states_between(frames.folder, number, *ALL_TIME)
    return calibrate_unknown(exposures, states, cameras, field_deg, settings)


def calibration_message(report: CameraReport) -> dict[str, Any]:
    """Return the fields of a foxglove.CameraCalibration with the camera that was found."""
    c = report.camera
    assert c is not None
    model, coefficients = distortion_of(c._asdict())
    message = {
        "frame_id": report.sensor_id,
        "width": c.width,
        "height": c.height,
        "distortion_model": model,
        "D": [round(v, 9) for v in coefficients],
        "K": [round(v, 3) for v in (c.fx_px, 0.0, c.cx_px, 0.0, c.fy_px, c.cy_px, 0.0, 0.0, 1.0)],
    }
    return message | ({"line_time_s": c.line_time_s} if c.line_time_s else {})


def as_dict(report: CameraReport) -> dict[str, Any]:
    """Return a report for JSON."""
    found = report.camera is not None
    return {
        "sensor_id": report.sensor_id,
        "found": found,
        "mirrored": report.is_mirrored,
        "frames": report.n_frames,
        "identified": report.n_identified,
        "stars": report.n_stars,
        "residual_px": None if math.isnan(report.residual_px) else report.residual_px,
        "stated": report.nominal._asdict() if report.has_calibration else None,
        "sigma": report.sigma,
        "calibration": calibration_message(report) if found else None,
    }


def lines(report: CameraReport) -> list[str]:
    """Return a report as lines for people."""
    if report.camera is None:
        return [report.sensor_id, *_not_found(report)]
    out = [
        report.sensor_id,
        f"  identified       {report.n_identified} of {many(report.n_frames, 'frame')} by "
        f"{many(report.n_stars, 'star')}{_residual(report)}",
        f"  image            {_image(report)}",
        f"  focal length     {_focal(report)}",
    ]
    if report.sigma:
        names = ("cx_px", "cy_px"), ("k1", "k2", "p1", "p2", "k3")
        out += [f"  principal point  {_values(report, names[0])}",
                f"  distortion       {_values(report, names[1])}"]  # fmt: skip
    else:
        out.append("  distortion       as stated; 60 stars in 3 frames are needed to fit it")
    if report.is_mirrored:
        out.append(
            "  mirrored         rows count upward (y up): the second focal length of K is < 0"
        )
    return [*out, "  foxglove.CameraCalibration to write into the log:",
            f"    {json.dumps(calibration_message(report))}"]  # fmt: skip


def _not_found(report: CameraReport) -> list[str]:
    nominal = report.nominal
    narrow, wide = (
        nominal._replace(fx_px=nominal.fx_px * factor).field_deg[0]
        for factor in (report.reach, 1 / report.reach)
    )
    return [
        f"  not found        no two of the frames tried ({many(report.n_frames, 'frame')}) show "
        f"the same camera, for any field of {narrow:.1f} to {wide:.1f} deg",
        "                   check that the frames show stars; give another --field",
    ]


def _residual(report: CameraReport) -> str:
    return "" if math.isnan(report.residual_px) else f", rms {report.residual_px:.2f} px per axis"


def _image(report: CameraReport) -> str:
    size = f"{report.nominal.width} x {report.nominal.height} px"
    return (
        size
        if report.has_image_size
        else f"{size}, as far as centroids reach: no calibration in the log"
    )


def _focal(report: CameraReport) -> str:
    c, nominal = report.camera, report.nominal
    assert c is not None
    sigma = f" +- {report.sigma['fx_px']:.2f}" if report.sigma else ""
    text = f"{c.fx_px:.2f}{sigma} px, a field of {c.field_deg[0]:.2f} deg along the columns"
    if not report.has_calibration:
        return text
    percent = 100 * (c.fx_px / nominal.fx_px - 1)
    return f"{text}; {percent:+.2f} % of {nominal.fx_px:.2f}"


def _values(report: CameraReport, names: tuple[str, ...]) -> str:
    digits = 2 if names[0].endswith("_px") else 5
    values = report.camera._asdict() if report.camera else {}
    return ", ".join(
        f"{name.removesuffix('_px')} {values[name]:.{digits}f} +- {report.sigma[name]:.{digits}f}"
        if _corner_px(report, name) <= MOST_CORNER_PX
        else f"{name} not known"
        for name in names
    )


def _corner_px(report: CameraReport, name: str) -> float:
    """Return by how much 1-sigma of a term of the distortion moves the corner of the image [px]."""
    c = report.camera
    if c is None or name not in PINHOLE_TERMS:
        return 0.0
    corner = math.hypot(c.width / 2 / c.fx_px, c.height / 2 / c.fy_px)
    return float(report.sigma[name] * corner ** (PINHOLE_TERMS[name] + 1) * abs(c.fx_px))
