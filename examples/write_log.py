"""Write a log that `epipole run` reads, from arrays of your own.

    python examples/write_log.py my_night.mcap
    epipole info my_night.mcap

Replace `arrays_of` by your arrays. What each column means: docs/input.md. Here they come from the
example log beside this file: four sensors that see nine objects for a minute.
"""

import sys
from pathlib import Path

import numpy as np
import polars as pl

from epipole.flows import api

EXAMPLE = Path(__file__).with_name("four_sensor_geo.mcap")


def frames_table(sensor, time, x_px, y_px, flux, sigma_px):
    """Return a row per exposure.

    sensor : its id: letters, digits, - and _; the same in all three tables.
    time : (n,) datetime64, the middle of each exposure, UTC.
    x_px, y_px, flux, sigma_px : n arrays, one number for each bright spot of that exposure.
        Pixel (0, 0) is the middle of the top-left pixel, x to the right, y down. Flux is linear
        (photons, counts: any unit). Sigma is the error per axis. Leave the columns `flux` and
        `sigma_px` out where you do not know them.
    """
    return pl.DataFrame(
        {
            "sensor_id": [sensor] * len(time),
            "time": time,
            "frame_number": np.arange(len(time)),  # it has to grow with time
            "exposure_s": np.full(len(time), 0.2),
            "x_px": [list(x) for x in x_px],
            "y_px": [list(y) for y in y_px],
            "flux": [list(f) for f in flux],
            "sigma_px": [list(s) for s in sigma_px],
        }
    )


def states_table(sensor, time, r_km, v_km_s):
    """Return a row per point of the ephemeris: where the sensor was.

    time : (m,) datetime64, UTC; not the times of the frames. A point every few seconds is enough.
    r_km, v_km_s : (m, 3), GCRF (axes of the ICRS, origin in the Earth's middle).

    An attitude is not needed: the stars give it. Where you have one, add the columns `qx`, `qy`,
    `qz`, `qw` (it turns ICRS into sensor axes) and `attitude_sigma_arcsec`.
    """
    return pl.DataFrame(
        {
            "sensor_id": [sensor] * len(time),
            "time": time,
            **{f"{axis}_km": r_km[:, k] for k, axis in enumerate("xyz")},
            **{f"v{axis}_km_s": v_km_s[:, k] for k, axis in enumerate("xyz")},
            "position_sigma_km": np.full(len(time), 0.02),
        }
    )


def cameras_table(sensor, time):
    """Return a row per calibration: the optics from `time` on.

    The focal length in pixels follows from the field: width / (2 tan(field / 2)). Distortion
    (k1, k2, p1, p2, k3 of OpenCV) is 0 where it is left out; a run fits it to the stars.
    """
    width, field_deg = 512, 2.0
    focal_px = width / (2 * np.tan(np.radians(field_deg) / 2))
    return pl.DataFrame(
        {
            "sensor_id": [sensor],
            "time": np.array([time]),
            "width": [width],
            "height": [width],
            "fx_px": [focal_px],
            "fy_px": [focal_px],
            "cx_px": [(width - 1) / 2],
            "cy_px": [(width - 1) / 2],
        }
    )


def arrays_of(log, sensor):
    """Return the arrays of a sensor: here those of the example."""
    frames = log.frames.filter(pl.col("sensor_id") == sensor).sort("time")
    states = log.states.filter(pl.col("sensor_id") == sensor).sort("time")
    exposures = [frames[name].to_numpy() for name in ("time", "x_px", "y_px", "flux", "sigma_px")]
    r_km = states.select("x_km", "y_km", "z_km").to_numpy()
    v_km_s = states.select("vx_km_s", "vy_km_s", "vz_km_s").to_numpy()
    return exposures, (states["time"].to_numpy(), r_km, v_km_s)


def main(path):
    """Write the log."""
    example = api.read_log(EXAMPLE)
    frames, states, cameras = [], [], []
    for sensor in sorted(example.frames["sensor_id"].unique()):
        exposures, ephemeris = arrays_of(example, sensor)
        frames.append(frames_table(sensor, *exposures))
        states.append(states_table(sensor, *ephemeris))
        cameras.append(cameras_table(sensor, exposures[0][0]))
    api.write_log(path, *(pl.concat(tables) for tables in (frames, states, cameras)))

    # Read it again: what could not be used would stand in `rejects`, with its reason.
    log = api.read_log(path)
    print(f"{path}: {log.frames.height} frames, {log.states.height} states")
    print(log.rejects if log.rejects.height else "nothing was left out")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "my_night.mcap")
