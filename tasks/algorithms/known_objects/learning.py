"""Learning: how large the errors of published elements are, from the sure matches of a night."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from epipole.tasks.algorithms.known_objects.matching import Candidate
from epipole.tasks.algorithms.known_objects.prediction import ElementErrors, sigmas

Array = npt.NDArray[np.float64]

# What is known before: each error is right within a factor of three (1-sigma of its logarithm).
PRIOR_SIGMA = float(np.log(3.0))
STEP = 0.7  # of the first search
FEWEST = 5  # matches from which anything is learnt


def learn_errors(
    matches: Sequence[Candidate], satellites: Sequence[object], start: ElementErrors
) -> ElementErrors:
    """Return the errors of elements under which the differences of sure matches are likeliest.

    Parameters
    ----------
    matches
        Sure matches.
    satellites
        Those of SGP4 that they are, in the same order.
    start
        What is known of the errors before.

    Returns
    -------
    ElementErrors
        The greatest posterior density, by the factors of: the error along at the epoch, its growth,
        the radial and the across error. `start` where there are fewer than `FEWEST` matches.
    """
    if len(matches) < FEWEST:
        return start

    apart_km = np.array([match.apart_km for match in matches])
    cov = np.array([match.cov for match in matches])
    lever = np.array([match.lever for match in matches])

    def cost(log_factors: Array) -> float:
        errors = _scaled(start, np.exp(log_factors))
        sigma = np.array(
            [sigmas(s, m.age_days, errors) for s, m in zip(satellites, matches, strict=True)]
        )
        S = cov + (lever * sigma[:, None, :] ** 2) @ np.swapaxes(lever, 1, 2)
        d2 = np.einsum("ni,ni->n", apart_km, np.linalg.solve(S, apart_km[:, :, None])[:, :, 0])
        log_det = np.linalg.slogdet(S)[1]
        return float((d2 + log_det).sum() + (log_factors**2).sum() / PRIOR_SIGMA**2)

    corners = np.vstack([np.zeros(4), STEP * np.eye(4)])
    options = {"initial_simplex": corners, "xatol": 0.01, "fatol": 0.01}
    found = minimize(cost, np.zeros(4), method="Nelder-Mead", options=options)
    return _scaled(start, np.exp(found.x))


def _scaled(errors: ElementErrors, factors: Array) -> ElementErrors:
    at_epoch, growth, radial, across = factors.tolist()
    return ElementErrors(
        errors.along_km * at_epoch,
        errors.along_km_day * growth,
        errors.radial_km * radial,
        errors.radial_km_day * radial,
        errors.across_km * across,
        errors.across_km_day * across,
    )
