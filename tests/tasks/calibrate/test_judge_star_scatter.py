"""Stated errors of the stars of a span: each star has that of its centroid."""

import numpy as np
import polars as pl

from epipole.schemas.bridge import from_polars
from epipole.schemas.work_tables import EXPOSURES
from epipole.tasks.calibrate.judge_star_scatter import stated_sigmas


def test_each_star_has_the_error_of_its_centroid():
    lists = [[0.1, 0.2], None, [0.0, 0.4]]
    exposures = from_polars(EXPOSURES, pl.DataFrame({
        "sensor_id": ["a"] * 3, "frame_number": [5, 6, 7],
        "time": pl.Series([1, 2, 3]).cast(pl.Datetime("ns", "UTC")), "exposure_s": [0.1] * 3,
        "x_px": [[1.0, 2.0]] * 3, "y_px": [[1.0, 2.0]] * 3, "flux": [None] * 3,
        "sigma_px": lists, "source": ["log"] * 3, "offset": [0] * 3,
    }))  # fmt: skip
    stars = pl.DataFrame({"frame_number": [7, 5, 6, 7, 9], "centroid": [1, 0, 1, 0, 0]})
    np.testing.assert_allclose(
        stated_sigmas(exposures, stars), [0.4, 0.1, np.nan, np.nan, np.nan], rtol=1e-6
    )
