"""Simulate a scene: write a log and its truth."""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
import pyarrow as pa

from epipole.io.logs.messages.registry import encoding_named
from epipole.io.logs.writer import LogWriter, calibration_values
from epipole.io.paths import fault_of_name
from epipole.io.simulation.scenes import read_scene
from epipole.io.simulation.truth import SUFFIX, TruthWriter
from epipole.schemas.errors import SceneError
from epipole.schemas.log_messages import CALIBRATION
from epipole.schemas.scene import Scene, validate_scene
from epipole.schemas.star_lists import ElementSet
from epipole.tasks.algorithms.simulation.constants import ARCSEC, SECOND_NS
from epipole.tasks.algorithms.simulation.exposures import Exposures
from epipole.tasks.algorithms.simulation.paths import Paths
from epipole.tasks.algorithms.simulation.sensor import (
    Attitudes,
    Beliefs,
    SimulatedSensor,
    seconds_since,
    state_times,
)
from epipole.tasks.simulate.draw_sensors import sent_optics
from epipole.tasks.simulate.simulate_scene import (
    SceneSky,
    Simulation,
    expose_blocks,
    simulate_scene,
    true_orbits,
    true_tables,
)

MAX_LOGS = 500  # all are open at once, and a process may mostly open 1,024 files


@dataclass(frozen=True)
class Simulated:
    """The files that were written, and their counts."""

    logs: list[Path]
    truth: Path
    sensors: int
    objects: int
    frames: int
    centroids: int


class SceneOptions(TypedDict, total=False):
    """Values used instead of a scene's; None leaves the scene's.

    seed, hours, seconds, start : its seed, duration and start (an aware datetime)
    sensors, objects : the number of them in the first group of sensors and of targets
    satellites : the number of satellites of a constellation
    near : whether those are near each other; False leaves what the scene says
    elements : file of element sets, real satellites instead of the objects of the first group
    rate_hz : frames per second of every sensor
    """

    seed: int | None
    sensors: int | None
    objects: int | None
    satellites: int | None
    near: bool
    elements: str | os.PathLike[str] | None
    hours: float | None
    seconds: float | None
    rate_hz: float | None
    start: datetime | None


def simulate(
    scene: str | os.PathLike[str] | Scene,
    out: str | os.PathLike[str],
    *,
    logs: int = 1,
    encoding: str = "protobuf",
    compression: str = "zstd",
    **options: Unpack[SceneOptions],
) -> Simulated:
    """Simulate a scene: write its log, and its truth to the folder ``<out>.truth``.

    Parameters
    ----------
    scene
        The name of a built-in scene, a TOML file, or a scene.
    out
        The log to write, an MCAP file. For a constellation (a scene with `shells`), a name
        without ``.mcap`` is a folder, with one log for each satellite.
    logs
        The number of logs, one after the other in time. Several logs are called
        ``<stem>-1.mcap`` and so on. The truth is still ``<out>.truth``.
    encoding, compression
        See `LogWriter`.
    options
        See `SceneOptions`.

    Raises
    ------
    SceneError
        Where the scene or an option is invalid, the encoding cannot hold its calibrations or
        times, or the log cannot be written.
    """
    settled = scene if isinstance(scene, Scene) else read_scene(scene)
    settled = _with_options(settled, options)
    if not 1 <= logs <= MAX_LOGS:
        raise SceneError(f"logs = {logs}: give 1 to {MAX_LOGS}")
    out = Path(out)
    if (fault := fault_of_name(out.name)) is not None:
        raise SceneError(f"log {out}: {fault}")
    if not isinstance(scene, Scene) and out.exists() and out.resolve() == Path(scene).resolve():
        raise SceneError(f"{out}: is the scene itself; give another file for the log")
    is_folder = out.suffix != ".mcap" and any(g.orbit.shells for g in settled.sensors)
    if is_folder and logs > 1:
        raise SceneError(f"logs = {logs}: a folder has one log for each satellite")
    _check_encoding(settled, encoding)
    simulation = simulate_scene(settled)
    form: dict[str, Any] = {"encoding": encoding, "compression": compression}
    try:
        if is_folder:
            return _write_folder(simulation, out, form)
        names = [out] if logs == 1 else [out.with_stem(f"{out.stem}-{k + 1}") for k in range(logs)]
        return _write_in_time(simulation, out, names, form)
    except OSError as error:
        raise SceneError(f"{out}: cannot be written: {error}") from error


def _check_encoding(scene: Scene, encoding: str) -> None:
    """Raise where messages of an encoding cannot hold the calibrations or the end of a scene."""
    form = encoding_named(encoding)
    end_ns = round((scene.start.timestamp() + scene.duration_s) * SECOND_NS)
    for sensor in scene.sensors:
        camera = sent_optics(sensor.camera)._asdict()
        try:
            form.encode(CALIBRATION, calibration_values(sensor.id, end_ns, camera))
        except ValueError as error:
            raise SceneError(f"{scene.name} as {encoding}: {error}") from error


def _write_in_time(
    simulation: Simulation, out: Path, names: list[Path], form: dict[str, Any]
) -> Simulated:
    """Write all sensors to the same logs, one log after the other in time."""
    out.parent.mkdir(parents=True, exist_ok=True)
    truth = Path(str(out) + SUFFIX)
    with ExitStack() as stack:
        writers = [stack.enter_context(LogWriter(name, **form)) for name in names]
        true = stack.enter_context(TruthWriter(truth, scenario(simulation)))
        _write_orbits(simulation, true)
        members = range(len(simulation.sensors))
        counts = _write(simulation, members, SceneSky(simulation), writers, true)
    return _simulated(simulation, names, truth, counts)


def _write_folder(simulation: Simulation, out: Path, form: dict[str, Any]) -> Simulated:
    """Write one log for each satellite, one after the other: memory is that of one."""
    sensors_of: dict[str, list[int]] = {}
    for k, satellite in enumerate(simulation.satellites):
        sensors_of.setdefault(satellite, []).append(k)
    names = [out / f"{satellite}.mcap" for satellite in sensors_of]
    out.mkdir(parents=True, exist_ok=True)
    if others := sorted(set(out.iterdir()) - set(names)):
        raise SceneError(f"{out}: has other files, such as {others[0].name}; give a new folder")
    sky, truth, counts = SceneSky(simulation), Path(str(out) + SUFFIX), (0, 0)
    with TruthWriter(truth, scenario(simulation)) as true:
        _write_orbits(simulation, true)
        for name, members in zip(names, sensors_of.values(), strict=True):
            with LogWriter(name, **form) as writer:
                n_frames, n_centroids = _write(simulation, members, sky, [writer], true)
            counts = counts[0] + n_frames, counts[1] + n_centroids
    return _simulated(simulation, names, truth, counts)


def _write_orbits(simulation: Simulation, true: TruthWriter) -> None:
    if (orbits := true_orbits(simulation)) is not None:
        true.write_orbits(orbits)


def _simulated(
    simulation: Simulation, names: list[Path], truth: Path, counts: tuple[int, int]
) -> Simulated:
    return Simulated(names, truth, len(simulation.sensors), len(simulation.objects), *counts)


def scenario(simulation: Simulation) -> dict[str, Any]:
    """Return how a log was made: the scene, and what was drawn at random for it."""
    return {
        "t0_ns": simulation.t0_ns,
        "duration_s": simulation.scene.duration_s,
        "seed": simulation.scene.seed,
        "sensors": [_describe_sensor(simulation, k) for k in range(len(simulation.sensors))],
        "targets": [_describe_object(simulation, k) for k in range(len(simulation.objects))],
        "scene": simulation.scene.model_dump(mode="json"),
    }


def _describe_sensor(simulation: Simulation, k: int) -> dict[str, Any]:
    s, faults = simulation.sensors[k], simulation.groups[k].faults
    described = {
        "id": s.sensor_id,
        "sat": simulation.satellites[k],
        **_describe_path(s.path, simulation.sensor_sets[k]),
        "rate_hz": s.rate_hz,
        "phase": s.phase,
        "mag_limit": s.magnitude_limit,
        "sigma_px": s.sigma_px,
        "camera": dict(s.optics._asdict()),
    }
    if s.mode == "body":
        described |= {
            "azimuth_deg": math.degrees(s.azimuth),
            "elevation_deg": math.degrees(s.elevation),
        }
    if simulation.groups[k].clock_offset_s:
        described["clock_s"] = simulation.groups[k].clock_offset_s
    if s.position_offset_km.any():
        described |= {
            "pos_off_km": s.position_offset_km.tolist(),
            "pos_off_told": faults.position_told,
        }
    if s.prior_offset.any():
        described |= {
            "prior_bias_vec_arcsec": (s.prior_offset / ARCSEC).tolist(),
            "prior_bias_told": faults.prior_told,
        }
    return described


def _describe_object(simulation: Simulation, k: int) -> dict[str, Any]:
    objects = simulation.objects
    key = "standard_mag" if objects.is_standard[k] else "mag"
    path = _describe_path(objects.paths.of(k), simulation.object_sets[k])
    return {"object": k} | path | {key: float(objects.magnitude[k])}


def _describe_path(path: Paths, element_set: ElementSet | None) -> dict[str, Any]:
    """Return the elements of a path, or the satellite whose element set it follows."""
    if element_set is None:
        return {"elements": path.elements[0].tolist()}
    epoch = np.datetime64(element_set.epoch_ns, "ns")
    if not element_set.number:
        return {"name": element_set.name}
    return {
        "name": element_set.name,
        "norad": element_set.number,
        "norad_id": element_set.number,
        "element_epoch": f"{np.datetime_as_string(epoch, unit='ms')}Z",
    }


def _with_options(scene: Scene, options: SceneOptions) -> Scene:
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    values = scene.model_dump(exclude_unset=True)
    _change_satellites(values, given, scene)
    if "hours" in given and "seconds" in given:
        raise SceneError("give hours or seconds, not both")
    if "hours" in given:
        given["seconds"] = given["hours"] * 3600.0
    names = {"seed": "seed", "start": "start", "seconds": "duration_s"}
    values |= {name: given[key] for key, name in names.items() if key in given}
    if "sensors" in given:
        values["sensors"][0]["count"] = given["sensors"]
    if "objects" in given:
        number = given["objects"]
        if not values.get("targets"):
            raise SceneError(f"{scene.name}: has no targets, so their number cannot be {number}")
        values["targets"][0]["count"] = number
    if "rate_hz" in given:
        for sensor in values["sensors"]:
            sensor["rate_hz"] = given["rate_hz"]
    return validate_scene(values, scene.name)


def _change_satellites(values: dict[str, Any], given: dict[str, Any], scene: Scene) -> None:
    """Change the groups of a scene's values that are on satellites, as the options say."""
    groups = [g for g in values["sensors"] + values.get("targets", []) if g["orbit"].get("shells")]
    if not groups and ("satellites" in given or given.get("near")):
        raise SceneError(
            f"{scene.name}: is no constellation, so it takes neither satellites nor near"
        )
    if groups and "sensors" in given:
        raise SceneError(f"{scene.name}: is a constellation: give satellites instead of sensors")
    for group in groups:
        group["count"] = given.get("satellites", group.get("count"))
        if given.get("near"):
            group["orbit"]["near"] = True
    if "elements" in given:
        if not values.get("targets"):
            raise SceneError(f"{scene.name}: has no targets that element sets could replace")
        target = values["targets"][0]
        target["orbit"] = {"elements": os.fspath(given["elements"]), "usable_only": True}
        for name in ("count", "spread_km"):
            target.pop(name, None)


def _write(
    simulation: Simulation,
    members: Sequence[int],
    sky: SceneSky,
    writers: list[LogWriter],
    true: TruthWriter,
) -> tuple[int, int]:
    """Write the messages of some sensors in order of time, calibrations first.

    The counts of frames and centroids are returned.
    """
    for k in members:
        for writer in writers:
            camera = sent_optics(simulation.groups[k].camera)
            writer.camera(simulation.sensors[k].sensor_id, simulation.t0_ns, camera)
    bounds = _log_bounds(simulation, len(writers))
    states = [_States(simulation, k) for k in members]
    n_frames = n_centroids = 0
    for block in expose_blocks(simulation, members, sky):
        _write_truth(simulation, members, block, true)
        ends = [int(exposed.time_ns[-1]) for exposed in block if len(exposed.time_ns)]
        until = max(ends, default=0) + 1
        messages = [m for s in states for m in s.until(until)]
        for k, exposed in zip(members, block, strict=True):
            messages += _frames(simulation, k, exposed)
            n_frames += len(exposed.time_ns)
            n_centroids += int(exposed.offsets[-1])
        _send(messages, writers, bounds)
    _send([m for s in states for m in s.until(None)], writers, bounds)
    return n_frames, n_centroids


def _write_truth(
    simulation: Simulation, members: Sequence[int], block: list[Exposures], true: TruthWriter
) -> None:
    tables = [
        true_tables(simulation.sensors[k].sensor_id, exposed)
        for k, exposed in zip(members, block, strict=True)
    ]
    frames, points = zip(*tables, strict=True)
    true.write(pa.concat_tables(frames), pa.concat_tables(points))


def _log_bounds(simulation: Simulation, n: int) -> np.ndarray:
    length_ns = round(simulation.scene.duration_s * SECOND_NS)
    return simulation.t0_ns + np.arange(1, n) * (length_ns // n)


# The time of a message, the sensor, the method of the writer and its arguments.
_Message = tuple[int, str, str, dict[str, Any]]


def _send(messages: list[_Message], writers: list[LogWriter], bounds: np.ndarray) -> None:
    messages.sort(key=lambda message: message[:3])
    for time_ns, sensor_id, method, values in messages:
        k = int(np.searchsorted(bounds, time_ns, side="right")) if len(bounds) else 0
        getattr(writers[k], method)(sensor_id, time_ns, **values)


def _frames(simulation: Simulation, k: int, exposed: Exposures) -> Iterator[_Message]:
    sensor, group = simulation.sensors[k], simulation.groups[k]
    detection, late_ns = group.detection, round(group.clock_offset_s * SECOND_NS)
    x, y = exposed.x_px.astype(np.float32), exposed.y_px.astype(np.float32)
    flux, sigma = exposed.flux.astype(np.float32), exposed.sigma_px.astype(np.float32)
    offsets = exposed.offsets.tolist()
    numbers, times = exposed.frame_number.tolist(), exposed.time_ns.tolist()
    for i, time_ns in enumerate(times):
        part = slice(offsets[i], offsets[i + 1])
        values = {
            "frame_number": numbers[i],
            "exposure_s": sensor.exposure_s,
            "x_px": x[part],
            "y_px": y[part],
            "flux": flux[part] if detection.send_flux else None,
            "sigma_px": sigma[part] if detection.send_sigma else None,
        }
        yield time_ns + late_ns, sensor.sensor_id, "frame", values


class _States:
    """The states of one sensor, sent block by block in order of time."""

    def __init__(self, simulation: Simulation, k: int) -> None:
        self.sensor: SimulatedSensor = simulation.sensors[k]
        self._settings = simulation.groups[k].states
        self._attitudes, self._beliefs = Attitudes(self.sensor), Beliefs(self.sensor)
        self._times, self._sent = state_times(self.sensor), 0

    def until(self, time_ns: int | None) -> Iterator[_Message]:
        s = self.sensor
        end = len(self._times) if time_ns is None else int(np.searchsorted(self._times, time_ns))
        times, self._sent = self._times[self._sent : end], max(end, self._sent)
        if not len(times):
            return
        r_km, v_km_s = s.path.at(seconds_since(s.t0_ns, times))
        believed = self._beliefs.attitude(self._attitudes.at(times, r_km, v_km_s))
        q = None if believed is None else believed.as_quat()
        position_km = self._beliefs.position(r_km)
        sigma_km = self._beliefs.position_sigma_km
        sigma_q = self._beliefs.attitude_sigma / ARCSEC
        for i, at in enumerate(times.tolist()):
            values: dict[str, Any] = {
                "position_km": position_km[i],
                "velocity_km_s": v_km_s[i] if self._settings.send_velocity else None,
                "position_sigma_km": sigma_km,
                "attitude_xyzw": None if q is None else q[i],
                "attitude_sigma_arcsec": sigma_q,
            }
            yield at, s.sensor_id, "state", values
