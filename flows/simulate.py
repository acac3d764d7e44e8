"""Simulate a scene: write a log and its truth."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from epipole.io.logs.writer import LogWriter
from epipole.io.paths import fault_of_name
from epipole.io.simulation.scenes import read_scene
from epipole.io.simulation.truth import SUFFIX, TruthWriter
from epipole.schemas.errors import SceneError
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


def simulate(
    scene: str | os.PathLike[str] | Scene,
    out: str | os.PathLike[str],
    *,
    seed: int | None = None,
    sensors: int | None = None,
    objects: int | None = None,
    hours: float | None = None,
    rate_hz: float | None = None,
    start: datetime | None = None,
    logs: int = 1,
    encoding: str = "protobuf",
    compression: str = "zstd",
) -> Simulated:
    """Simulate a scene: write its log, and its truth to the folder ``<out>.truth``.

    Parameters
    ----------
    scene
        The name of a built-in scene, a TOML file, or a scene.
    out
        The log to write, an MCAP file.
    seed, hours, start
        Used instead of the scene's seed, duration and start (an aware datetime).
    sensors, objects
        The number of them in the scene's first group of sensors and of targets.
    rate_hz
        Frames per second of every sensor.
    logs
        The number of logs, one after the other in time. Several logs are called
        ``<stem>-1.mcap`` and so on. The truth is still ``<out>.truth``.
    encoding, compression
        See `LogWriter`.

    Raises
    ------
    SceneError
        Where the scene or an option is invalid, or the log cannot be written.
    """
    settled = scene if isinstance(scene, Scene) else read_scene(scene)
    settled = _with_options(settled, seed, sensors, objects, hours, rate_hz, start)
    if not 1 <= logs <= MAX_LOGS:
        raise SceneError(f"logs = {logs}: give 1 to {MAX_LOGS}")
    out = Path(out)
    if (fault := fault_of_name(out.name)) is not None:
        raise SceneError(f"log {out}: {fault}")
    names = [out] if logs == 1 else [out.with_stem(f"{out.stem}-{k + 1}") for k in range(logs)]
    truth = Path(str(out) + SUFFIX)
    simulation = simulate_scene(settled)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            writers = [
                stack.enter_context(LogWriter(name, encoding=encoding, compression=compression))
                for name in names
            ]
            true = stack.enter_context(TruthWriter(truth, scenario(simulation)))
            if (orbits := true_orbits(simulation)) is not None:
                true.write_orbits(orbits)
            frames, centroids = _write(simulation, writers, true)
    except OSError as error:
        raise SceneError(f"{out}: cannot be written: {error}") from error
    return Simulated(
        names, truth, len(simulation.sensors), len(simulation.objects), frames, centroids
    )


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
        **_describe_path(s.path, simulation.sensor_sets[k]),
        "rate_hz": s.rate_hz,
        "phase": s.phase,
        "mag_limit": s.magnitude_limit,
        "sigma_px": s.sigma_px,
        "camera": dict(s.optics._asdict()),
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
    return path | {key: float(objects.magnitude[k])}


def _describe_path(path: Paths, element_set: ElementSet | None) -> dict[str, Any]:
    """Return the elements of a path, or the satellite whose element set it follows."""
    if element_set is None:
        return {"elements": path.elements[0].tolist()}
    epoch = np.datetime64(element_set.epoch_ns, "ns")
    return {
        "name": element_set.name,
        "norad_id": element_set.number,
        "element_epoch": f"{np.datetime_as_string(epoch, unit='ms')}Z",
    }


def _with_options(
    scene: Scene,
    seed: int | None,
    sensors: int | None,
    objects: int | None,
    hours: float | None,
    rate_hz: float | None,
    start: datetime | None,
) -> Scene:
    values = scene.model_dump(exclude_unset=True)
    top = {
        "seed": seed,
        "start": start,
        "duration_s": None if hours is None else hours * 3600.0,
    }
    values |= {key: value for key, value in top.items() if value is not None}
    if sensors is not None:
        values["sensors"][0]["count"] = sensors
    if objects is not None:
        if not values.get("targets"):
            raise SceneError(f"{scene.name}: has no targets, so their number cannot be {objects}")
        values["targets"][0]["count"] = objects
    if rate_hz is not None:
        for sensor in values["sensors"]:
            sensor["rate_hz"] = rate_hz
    return validate_scene(values, scene.name)


def _write(simulation: Simulation, writers: list[LogWriter], true: TruthWriter) -> tuple[int, int]:
    """Write all messages in order of time, calibrations first. Return the counts."""
    for sensor, group in zip(simulation.sensors, simulation.groups, strict=True):
        for writer in writers:
            writer.camera(sensor.sensor_id, simulation.t0_ns, sent_optics(group.camera))
    bounds = _log_bounds(simulation, len(writers))
    states = [_States(simulation, k) for k in range(len(simulation.sensors))]
    n_frames = n_centroids = 0
    for block in expose_blocks(simulation):
        _write_truth(simulation, block, true)
        ends = [int(exposed.time_ns[-1]) for exposed in block if len(exposed.time_ns)]
        until = max(ends, default=0) + 1
        messages = [m for s in states for m in s.until(until)]
        for k, exposed in enumerate(block):
            messages += _frames(simulation, k, exposed)
            n_frames += len(exposed.time_ns)
            n_centroids += int(exposed.offsets[-1])
        _send(messages, writers, bounds)
    _send([m for s in states for m in s.until(None)], writers, bounds)
    return n_frames, n_centroids


def _write_truth(simulation: Simulation, block: list[Exposures], true: TruthWriter) -> None:
    tables = [
        true_tables(sensor.sensor_id, exposed)
        for sensor, exposed in zip(simulation.sensors, block, strict=True)
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
