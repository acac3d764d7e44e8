"""The methods of association, called alike: samples, focal lengths and settings in, groups out."""

import numpy as np
import numpy.typing as npt

from epipole.schemas.settings import AssociationSettings
from epipole.tasks.algorithms.association.epipolar_lines import associate_by_lines
from epipole.tasks.algorithms.association.likelihood import Shell, associate_tracklets
from epipole.tasks.algorithms.association.sampling.samples import Groups, Samples


def associate_by_likelihood(
    samples: Samples, focal_px: npt.NDArray[np.float64], settings: AssociationSettings
) -> Groups:
    """Return the groups of tracklets that are most likely one object each."""
    return associate_tracklets(
        samples,
        gate_sigma=settings.gate_sigma,
        min_altitude_km=settings.min_altitude_km,
        max_range_km=settings.max_range_km,
        min_log_odds=settings.min_log_odds,
        ambiguity_log_odds=settings.ambiguity_log_odds,
        shells=[Shell(s.lowest_km, s.highest_km, s.share) for s in settings.shells],
    )


def associate_by_epipolar_lines(
    samples: Samples, focal_px: npt.NDArray[np.float64], settings: AssociationSettings
) -> Groups:
    """Return the groups of tracklets that lie on each other's epipolar lines [published]."""
    return associate_by_lines(samples, focal_px, settings.threshold_px)
