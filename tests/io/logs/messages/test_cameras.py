"""Whether a distortion folds the image: as the camera of the pipeline has it, which io may not
import."""

import numpy as np

from epipole.io.logs.messages.cameras import FARTHEST_UNDISTORTED, _folds
from epipole.tasks.algorithms.geometry.camera import Camera, distort, fold_radius

CORNER, SIDE = 0.5, 0.36  # focal lengths


def test_a_log_is_refused_where_the_radial_distortion_folds_before_the_end_of_the_image():
    rng = np.random.default_rng(5)
    found = []
    for k1, k2, k3 in rng.normal(0.0, (3.0, 8.0, 20.0), (300, 3)).tolist():
        camera = Camera(1000, 1000, 1e3, 1e3, 499.5, 499.5, k1, k2, k3=k3)
        fold = min(fold_radius(camera), FARTHEST_UNDISTORTED * CORNER)
        (reach,), _ = distort(camera, np.array([fold]), np.zeros(1))
        if abs(reach / SIDE - 1) > 0.02:  # both search in steps
            found.append(reach < SIDE)
            D = (k1, k2, 0.0, 0.0, k3, 0.0)
            assert _folds(D, CORNER, SIDE, FARTHEST_UNDISTORTED * CORNER) == found[-1], D
    assert 20 < sum(found) < len(found) - 20
