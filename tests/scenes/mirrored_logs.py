"""A log written again with the rows of its images counted upward, and with or without a camera."""

from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import rows_of


def write_mirrored(log, out, calibrated=True):
    """Write the log with y up; the calibration, if any, is in the same convention."""
    contents, height = read_log(str(log)), {}
    with LogWriter(out) as writer:
        for row in rows_of(contents.cameras):
            name, time_ns = row.pop("sensor_id"), row.pop("time")
            height[name] = row["height"]
            flipped = {"cy_px": row["height"] - 1 - row["cy_px"], "p1": -row["p1"]}
            if calibrated:
                writer.camera(name, time_ns, row | flipped)
        for row in rows_of(contents.states):
            writer.state(
                row["sensor_id"], row["time"],
                position_km=[row[f"{a}_km"] for a in "xyz"],
                velocity_km_s=[row[f"v{a}_km_s"] for a in "xyz"],
            )  # fmt: skip
        for row in rows_of(contents.exposures):
            name = row["sensor_id"]
            writer.frame(
                name, row["time"], frame_number=row["frame_number"],
                exposure_s=row["exposure_s"], x_px=row["x_px"],
                y_px=[height[name] - 1 - y for y in row["y_px"]], flux=row["flux"],
                sigma_px=row["sigma_px"],
            )  # fmt: skip
    return out
