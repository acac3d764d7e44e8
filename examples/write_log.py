"""Write a log that `epipole run` reads, from arrays of your own.

    python examples/write_log.py my_night.mcap
    epipole info my_night.mcap

Replace the arrays in `main` by yours. What each column means: docs/input.md. Here one sensor in
a low orbit sees ten points for half a minute, so that the file can be looked at; points that lie
anywhere are no stars, so a run of it finds none.
"""

import sys

import numpy as np
import polars as pl

from epipole.flows import api

SENSOR = "sat1"  # letters, digits, - and _; the same in all three tables


def frames_table(time, x_px, y_px, flux, sigma_px):
    """Return a row per exposure.

    time : (n,) datetime64, the middle of each exposure, UTC.
    x_px, y_px, flux, sigma_px : n arrays, one number for each bright spot of that exposure.
        Pixel (0, 0) is the middle of the top-left pixel, x to the right, y down. Flux is linear
        (photons, counts: any unit). Sigma is the error per axis. Leave the columns `flux` and
        `sigma_px` out where you do not know them.
    """
    return pl.DataFrame(
        {
            "sensor_id": [SENSOR] * len(time),
            "time": time,
            "frame_number": np.arange(len(time)),  # it has to grow with time
            "exposure_s": np.full(len(time), 0.2),
            "x_px": [list(x) for x in x_px],
            "y_px": [list(y) for y in y_px],
            "flux": [list(f) for f in flux],
            "sigma_px": [list(s) for s in sigma_px],
        }
    )


def states_table(time, r_km, v_km_s):
    """Return a row per point of the ephemeris: where the sensor was.

    time : (m,) datetime64, UTC; not the times of the frames. A point every few seconds is enough.
    r_km, v_km_s : (m, 3), GCRF (axes of the ICRS, origin in the Earth's middle).

    An attitude is not needed: the stars give it. Where you have one, add the columns `qx`, `qy`,
    `qz`, `qw` (it turns ICRS into sensor axes) and `attitude_sigma_arcsec`.
    """
    return pl.DataFrame(
        {
            "sensor_id": [SENSOR] * len(time),
            "time": time,
            **{f"{axis}_km": r_km[:, k] for k, axis in enumerate("xyz")},
            **{f"v{axis}_km_s": v_km_s[:, k] for k, axis in enumerate("xyz")},
            "position_sigma_km": np.full(len(time), 0.02),
        }
    )


def cameras_table(time):
    """Return a row per calibration: the optics from `time` on.

    The focal length in pixels follows from the field: width / (2 tan(field / 2)). Distortion
    (k1, k2, p1, p2, k3 of OpenCV) is 0 where it is left out; a run fits it to the stars.
    """
    width, field_deg = 1024, 8.0
    focal_px = width / (2 * np.tan(np.radians(field_deg) / 2))
    return pl.DataFrame(
        {
            "sensor_id": [SENSOR],
            "time": np.array([time]),
            "width": [width],
            "height": [width],
            "fx_px": [focal_px],
            "fy_px": [focal_px],
            "cx_px": [(width - 1) / 2],
            "cy_px": [(width - 1) / 2],
        }
    )


def main(path):
    """Write the log."""
    rng = np.random.default_rng(1)
    start = np.datetime64("2031-04-01T04:00:00", "ns")

    # Your exposures: one every second.
    time = start + np.arange(30) * np.timedelta64(1, "s")
    x_px, y_px = rng.uniform(0, 1023, (2, len(time), 10))
    flux = rng.uniform(1e3, 1e5, (len(time), 10))
    sigma_px = np.full((len(time), 10), 0.1)

    # Your ephemeris: a circle of 7000 km around the Earth, a point every ten seconds.
    state_time = start + np.arange(-1, 5) * np.timedelta64(10, "s")
    angle = (state_time - start) / np.timedelta64(1, "s") * 7.546 / 7000
    r_km = 7000 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    v_km_s = 7.546 * np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])

    api.write_log(
        path,
        frames_table(time, x_px, y_px, flux, sigma_px),
        states_table(state_time, r_km, v_km_s),
        cameras_table(start),
    )

    # Read it again: what could not be used would stand in `rejects`, with its reason.
    log = api.read_log(path)
    print(f"{path}: {log.frames.height} frames, {log.states.height} states")
    print(log.rejects if log.rejects.height else "nothing was left out")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "my_night.mcap")
