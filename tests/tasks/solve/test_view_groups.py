"""Views as arrays: what known errors of a sensor change in them."""

import numpy as np
import pytest
from scenes.associations import filled

from epipole.io.work.work_layout import AddedErrors, SensorFault
from epipole.schemas.bridge import stack, stack_covariance, unstack
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.solve.view_groups import with_added_errors


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_keeps_the_ellipse_of_errors_where_the_axes_jump(sign):
    """At a declination of 64 degrees the axes of the tangent planes are others."""
    z = 0.9 - 1e-5 * np.array([1.0, 3.0, -3.0])  # the first one is turned over the jump
    level, at = np.sqrt(1 - z * z), np.radians(40.0)
    u = np.stack([level * np.cos(at), level * np.sin(at), sign * z], axis=1)
    views = filled(VIEWS, 3, {
        "sensor_id": ["a"] * 3, **unstack("u{}", u),
        "cov_noise_11_rad2": np.full(3, 1e-8), "cov_noise_22_rad2": np.full(3, 1e-10),
        "cov_bias_11_rad2": np.full(3, 4e-8), "cov_bias_22_rad2": np.full(3, 1e-10),
    })  # fmt: skip
    axis = sign * np.cross([0.0, 0.0, 1.0], u[0]) / level[0]
    # u - bias x u is nearer to the pole by 5e-5 rad.
    fault = SensorFault("a", left_rad=1e-12, bias_rad=tuple(5e-5 * axis))
    turned = with_added_errors(views, AddedErrors(faults=(fault,)))
    right = stack(turned, "u{}")
    assert ((np.abs(right[:, 2]) < 0.9) != (np.abs(u[:, 2]) < 0.9)).tolist() == [True, False, False]
    for part in ("noise", "bias"):
        before, after = (
            stack_covariance(table, f"cov_{part}_{{}}_rad2", TANGENT_AXES)
            for table in (views, turned)
        )
        ellipse, same = (
            np.swapaxes(basis, 1, 2) @ cov @ basis
            for basis, cov in ((tangent_basis(u), before), (tangent_basis(right), after))
        )
        np.testing.assert_allclose(same, ellipse, atol=1e-3 * np.abs(ellipse).max())
    np.testing.assert_allclose(np.linalg.norm(right - u, axis=1), 5e-5, rtol=1e-3)
