"""Star residuals: noise agrees with its sigma, patterns stand out, many rows are summed."""

import tracemalloc

import numpy as np
from scenes.made_nights import SECOND_NS, START_NS, filled, reader_of, seconds

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.report.frame_series import read_frame_series
from epipole.tasks.report.stars import (
    CELLS,
    HISTOGRAM,
    read_frame_concerned,
    read_star_map,
    read_star_residuals,
)

SIGMA_PX, FOCAL_PX, STARS = 0.1, 1000.0, 20


def night(n_frames, pattern_px=0.0, seed=1, of_objects=1.0, **tables):
    rng = np.random.default_rng(seed)
    n = n_frames * STARS
    frame = np.repeat(np.arange(n_frames), STARS)
    x, y = rng.uniform(0, 512, (2, n))
    # The fit of an attitude takes 3 of the 2 n degrees of freedom.
    noise = SIGMA_PX * np.sqrt(1 - 3 / (2 * STARS)) * rng.standard_normal((2, n))
    stars = filled("stars", sensor_id=np.full(n, "a"), time=START_NS + frame * 10**8,
                   frame_number=frame, x_px=x, y_px=y, dx_px=noise[0] + pattern_px * (x / 256 - 1),
                   dy_px=noise[1])  # fmt: skip
    sigma = [of_objects * SIGMA_PX / FOCAL_PX / ARCSEC] * 9
    tables |= {
        "stars": stars,
        "detections": filled("detections", sensor_id=["a"] * 9, sigma_arcsec=sigma),
        "calibrations": filled("calibrations", sensor_id=["a"], fx_px=[FOCAL_PX], fy_px=[FOCAL_PX]),
    }
    return reader_of(tables, in_group=1 << 17)


def found(made):
    columns = ["sensor_id", "fx_px", "fy_px"]
    return read_star_residuals(made, ["a"], made.read("calibrations", columns))


def test_noise_of_the_told_sigma_has_a_mean_square_of_one():
    residuals = found(night(2000))
    assert abs(residuals.mean_square[0] - 1) < 0.03  # the sigma is found to 1 %
    share = residuals.counts[0] / residuals.counts.sum()
    middle = (HISTOGRAM[1:] + HISTOGRAM[:-1]) / 2
    normal = np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi) * np.diff(HISTOGRAM)
    assert abs(share - normal).max() < 0.003


def test_sigmas_that_the_log_states_for_stars_count_more_than_those_of_detections():
    # Objects are brighter than the stars: their sigma is half as large.
    stated = filled("checks", sensor_id=["a"], check=["centroid_sigma"], expected=[SIGMA_PX])
    assert abs(found(night(500, of_objects=0.5)).mean_square[0] - 4) < 0.2
    assert abs(found(night(500, of_objects=0.5, checks=stated)).mean_square[0] - 1) < 0.05


def test_a_pattern_over_the_image_is_found():
    residuals = found(night(2000, pattern_px=0.2))
    across = residuals.mean_px[0, :, :, 0].mean(axis=0)
    assert (np.diff(across) > 0).all()
    assert abs(across[-1] - 0.2 * (1 - 1 / CELLS)) < 0.01


def test_two_million_rows_are_summed_in_pieces():
    made = night(100_000)
    tracemalloc.start()
    residuals = found(made)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert residuals.stars.tolist() == [2_000_000]
    assert residuals.in_cell.sum() == 2_000_000
    assert peak < 150e6  # a piece has 131,072 rows


def test_without_calibrations_there_is_no_sigma_but_a_pattern():
    made = night(50)
    residuals = read_star_residuals(
        made, ["a"], made.read("calibrations", ["sensor_id", "fx_px", "fy_px"]).clear()
    )
    assert residuals.counts.sum() == 0
    assert np.isnan(residuals.mean_square).all()
    assert residuals.in_cell.sum() == 1000


def test_a_night_without_stars_has_no_residuals():
    assert found(reader_of({})) is None


def published_every(step):
    """Return 40 frames of 2 stars, the third with the largest residual; stars of every n-th."""
    n = 40
    numbers = np.repeat(np.arange(0, n, step), 2)
    return reader_of({
        "frames": filled("frames", sensor_id=["a"] * n, time=seconds(n), frame_number=np.arange(n),
                         attitude_source=["stars"] * n, n_stars=[2] * n,
                         residual_px=[0.1, 0.1, 0.3] + [0.1] * (n - 3)),
        "stars": filled("stars", sensor_id=["a"] * len(numbers), frame_number=numbers,
                        time=START_NS + numbers * SECOND_NS),
    })  # fmt: skip


def test_the_map_is_of_a_frame_whose_stars_are_published():
    for step, in_middle, concerned in ((1, 20, 2), (7, 21, 0), (16, 0, 0)):
        made = published_every(step)
        series = read_frame_series(made)
        frames = read_star_map(made, series), read_frame_concerned(made, series, 0)
        assert [frame.frame_number for frame in frames] == [in_middle, concerned]
        assert [len(frame.star_id) for frame in frames] == [2, 2]
    assert read_star_map(published_every(100), series).frame_number == 0
    assert read_star_map(reader_of({}), series) is None
