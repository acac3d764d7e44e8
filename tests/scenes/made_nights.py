"""Nights made up table by table, as a report reads them."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.tables import TABLES

NIGHT = "2019-04-01"
START_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000


def reader_of(tables: dict[str, pa.Table], night: str = NIGHT, in_group: int = 1000) -> NightReader:
    """Return a night of these tables; the others have no rows."""
    files = {}
    for name, schema in TABLES.items():
        out = io.BytesIO()
        pq.write_table(tables.get(name, schema.empty_table()), out, row_group_size=in_group)
        files[name] = out.getvalue()
    return NightReader("made up", night, lambda table: [pa.BufferReader(files[table])])


def filled(table: str, /, **columns) -> pa.Table:
    """Return rows of a table: columns that are not given are null, 0, '' or the start."""
    count = max(len(values) for values in columns.values())
    blank = {"double": 0.0, "int64": 0, "int32": 0, "string": "", "bool": True}
    arrays = []
    for field in TABLES[table]:
        if field.name in columns:
            values = pa.array(columns[field.name])
        elif field.nullable:
            values = pa.nulls(count)
        elif "timestamp" in str(field.type):
            values = pa.array(np.full(count, START_NS))
        else:
            values = pa.array([blank[str(field.type)]] * count)
        arrays.append(values.cast(field.type))
    return pa.Table.from_arrays(arrays, schema=TABLES[table])


def seconds(count: int, step_s: float = 1.0) -> np.ndarray:
    """Return times, one every so many seconds."""
    return START_NS + (np.arange(count) * step_s * SECOND_NS).astype(np.int64)


def hostile_night(name: str) -> NightReader:
    """Return a night whose sensor, log, tracklet, object and satellite have this name."""
    n = 12
    time = seconds(n)
    return reader_of({
        "frames": filled("frames", sensor_id=[name] * n, time=time, frame_number=np.arange(n),
                         attitude_source=["stars"] * 6 + ["none"] * 6, n_stars=[1] * n,
                         status=[None] * 6 + [name] * 6, residual_px=[0.1] * n,
                         sigma_x_arcsec=[1.0] * n, sigma_y_arcsec=[1.0] * n,
                         sigma_z_arcsec=[9.0] * n),
        "stars": filled("stars", sensor_id=[name] * 6, time=time[:6], frame_number=np.arange(6),
                        star_id=np.arange(6), x_px=np.arange(6) * 50.0, y_px=np.arange(6) * 40.0,
                        dx_px=[0.1, -0.1] * 3, dy_px=[0.1, 0.1, -0.1] * 2),
        "detections": filled("detections", sensor_id=[name] * 6, time=time[:6], kind=["object"] * 6,
                             tracklet_id=[name] * 6, track_id=[name] * 6, ra_deg=[10.0] * 6,
                             dec_deg=[1.0] * 6, sigma_arcsec=[2.0] * 6),
        "tracklets": filled("tracklets", tracklet_id=[name], outcome=["object"], sensor_id=[name]),
        "positions": filled("positions", object_id=[name] * 3, x_km=[42164.0] * 3,
                            n_sensors=[2] * 3, chi2=[1.0] * 3, cov_xx=[1.0] * 3),
        "identifications": filled("identifications", object_id=[name], status=["known"],
                                  name=[name]),
        "objects": filled("objects", object_id=[name], n_positions=[3], verdict=[name],
                          name=[name]),
        "calibrations": filled("calibrations", sensor_id=[name], fx_px=[900.0], fy_px=[900.0]),
        "sources": filled("sources", name=[name], code_version=[name], settings_key=[name]),
        "rejects": filled("rejects", sensor_id=[name], source=[name], stage=["check"],
                          reason=["clock_off"], count=[3]),
    })  # fmt: skip
