"""Association by likelihood: the hypothesis that explains most, best first.

Two tracklets of two sensors whose lines of sight meet, within their errors, above the Earth,
begin a hypothesis; other sensors' tracklets that its points explain join it; hypotheses are
weighed against "all of these are different things" and taken best first. What two hypotheses
explain about equally well is not decided but called ambiguous.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.growth import grow_all
from epipole.tasks.algorithms.association.object_density import revised_odds, visible_volume
from epipole.tasks.algorithms.association.pool import Hypothesis, Pool, distinct
from epipole.tasks.algorithms.association.samples import (
    FREE,
    Chance,
    Groups,
    Samples,
    chance_of,
    views_of,
)
from epipole.tasks.algorithms.association.seeds import SensorPairs, seeds_between
from epipole.tasks.algorithms.association.visibility import EARTH_RADIUS_KM

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

DETECTED = 0.9  # before the data tell: a sensor that looks at an object has it
FEW_SENSORS = 6  # up to this many, every pair of sensors seeds; objects of two views are found
SEED_SIGMA = 2.5  # with more sensors: an object that one pair just misses, the next one has
UNSEEDED = 0.05  # objects that may be left without a seed, with more sensors than that
CLEAR_LOG_ODDS = 15.0  # with more sensors, such a group is taken before the next pair seeds
WORTH_A_LOOK = -3.0  # log-odds at which a group waits for what the number of objects says
BEYOND_DOUBT = 20.0  # log-odds that no number of objects brings down


class Shell(NamedTuple):
    """Heights [km above the equator's radius] at which a share of all objects is."""

    lowest_km: float
    highest_km: float
    share: float


def associate_tracklets(
    samples: Samples,
    *,
    gate_sigma: float,
    min_altitude_km: float,
    max_range_km: float,
    min_log_odds: float,
    ambiguity_log_odds: float,
    shells: Iterable[Shell] = (),
) -> Groups:
    """Return which tracklets are one object.

    Parameters
    ----------
    samples
        The tracklets at their common instants.
    gate_sigma
        Views of one object agree within this (as a chi-square just as rare).
    min_altitude_km, max_range_km
        Objects are looked for between this height and this distance from the Earth's centre.
    min_log_odds
        A group is reported if it is more likely than chance by this (natural log).
    ambiguity_log_odds
        Where another group that contradicts it comes closer than this, neither is.
    shells
        A weak prior on altitude; what they leave of the whole is anywhere. None: all heights
        are alike.

    Notes
    -----
    Deterministic: no random numbers, ties by the order of sensors and tracklets. The work
    grows with the number of tracklets times sensors, not with its square: see `seeds`.
    """
    if len(samples.sensor) == 0:
        return Groups(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, bool))
    limits = (EARTH_RADIUS_KM + min_altitude_km, max_range_km)
    chance = chance_of(samples, max_range_km, DETECTED)
    search = _Search(
        samples, chance, gate_sigma, limits, _weights(shells, max_range_km), ambiguity_log_odds
    )
    return search.run(min_log_odds)


def _weights(shells: Iterable[Shell], farthest_km: float) -> Array:
    """Return rows (lowest, highest radius, weight): density over that of objects anywhere."""
    rows, rest = [], 1.0
    for lowest, highest, share in shells:
        inner, outer = EARTH_RADIUS_KM + lowest, EARTH_RADIUS_KM + highest
        rows.append((inner, outer, share * farthest_km**3 / (outer**3 - inner**3)))
        rest -= share
    return np.array([*rows, (0.0, np.inf, max(rest, 0.01))] if rows else np.zeros((0, 3)))


class _Search:
    """Hypotheses over one set of samples."""

    def __init__(
        self,
        samples: Samples,
        chance: Chance,
        gate_sigma: float,
        limits: tuple[float, float],
        shells: Array,
        margin: float,
    ) -> None:
        self.views, self.order = views_of(samples)
        self.chance, self.gate_sigma, self.limits = chance, float(gate_sigma), limits
        self.shells, self.margin = shells.astype(float), float(margin)
        n = len(self.order)
        self.taken = np.zeros(n, np.bool_)
        self.group, self.ambiguous = np.full(n, FREE), np.zeros(n, np.bool_)
        self.scores: list[float] = []
        self.radius_km: list[float] = []

    def run(self, min_log_odds: float) -> Groups:
        """Return the groups: seed by seed, the clear ones at once, the others at the end."""
        pairs = SensorPairs(self.views, self.limits[1])
        many = len(self.views.half_field) > FEW_SENSORS
        waiting: list[Hypothesis] = []
        done: list[int] = []
        for k in pairs.in_turn():
            if many and pairs.covering(k, done) >= self._enough_pairs():
                continue
            waiting += self.hypotheses(*pairs.sensors(k))
            done.append(k)
            if many:
                self.take([h for h in waiting if h.score > CLEAR_LOG_ODDS], CLEAR_LOG_ODDS)
                waiting = [h for h in waiting if not self.taken[list(h.seed)].any()]
        self.take(waiting, WORTH_A_LOOK)
        scores = self._withdraw_doubtful(min_log_odds)
        group, ambiguous = np.empty_like(self.group), np.empty_like(self.ambiguous)
        group[self.order], ambiguous[self.order] = self.group, self.ambiguous
        return Groups(group, scores, ambiguous & (group == FREE))

    def _enough_pairs(self) -> int:
        """Return how many pairs must look at a place until no object there is likely unseeded.

        A pair misses an object where either sensor did.
        """
        missed = 1 - self.chance.detected**2
        return int(np.ceil(np.log(UNSEEDED / max(len(self.scores), 1)) / np.log(missed)))

    def _withdraw_doubtful(self, min_log_odds: float) -> Array:
        """Withdraw groups that are not sure enough once the number of objects is known.

        Returns the log-odds of those that are left.
        """
        scores = self._revised()
        kept = scores >= min_log_odds
        new = np.where(kept, np.cumsum(kept) - 1, FREE)
        member = self.group != FREE
        likely = ~kept & (scores > 0)
        self.ambiguous[member] |= likely[self.group[member]]
        self.group[member] = new[self.group[member]]
        return scores[kept]

    def _revised(self) -> Array:
        scores = np.array(self.scores)
        if not len(scores) or scores.min() > BEYOND_DOUBT:
            return scores
        anywhere = np.array([[0.0, np.inf, 1.0]])
        shells = self.shells if len(self.shells) else anywhere
        volume = visible_volume(self.views, shells, self.limits[1])
        return revised_odds(scores, np.array(self.radius_km), shells, volume, self.chance)

    def hypotheses(self, a: int, b: int) -> list[Hypothesis]:
        """Return what the pairs of two sensors' tracklets grow into."""
        many = len(self.views.half_field) > FEW_SENSORS
        gate_sigma = min(self.gate_sigma, SEED_SIGMA) if many else self.gate_sigma
        seeds = seeds_between(self.views, a, b, self.taken, *self.limits, gate_sigma)
        return distinct(self.grow(seeds))

    def grow(self, seeds: Indices) -> list[Hypothesis]:
        """Return what (n, 2) seeds grow into among the tracklets that are free."""
        n = len(seeds)
        sizes, scores, radius_km = np.zeros(n, np.int64), np.empty(n), np.empty(n)
        # More than two fragments a sensor are not kept; the next span has them again.
        grown = np.empty((n, min(2 * len(self.views.half_field), len(self.taken))), np.int64)
        grow_all(
            self.views, self.chance, seeds, self.taken, *self.limits, self.gate_sigma, self.shells,
            WORTH_A_LOOK - self.margin, sizes, scores, radius_km, grown,
        )  # fmt: skip
        return [
            Hypothesis(float(scores[q]), tuple(seeds[q].tolist()),
                       tuple(sorted(grown[q, : sizes[q]].tolist())), float(radius_km[q]))
            for q in np.flatnonzero(sizes)
        ]  # fmt: skip

    def take(self, hypotheses: list[Hypothesis], min_log_odds: float) -> None:
        """Accept hypotheses, best first; what rivals contest is ambiguous."""
        pool = Pool(hypotheses)
        while (best := pool.pop()) is not None:
            if best.score < min_log_odds:
                for h in (best, *pool.rest()):  # likelier than not, and not sure enough
                    self.ambiguous[list(h.members)] |= h.score > 0
                break
            if self.taken[list(best.members)].any():
                if not self.taken[list(best.seed)].any():
                    for again in self.grow(np.array([best.seed])):
                        pool.push(again)
                continue
            rivals = pool.rivals(best, self.margin, self.group != FREE)
            kept = set(best.members).intersection(*(h.members for h in rivals))
            sensors = {int(self.views.sensor[i]) for i in kept}
            # What is left of a group that lost most of its views is no object by itself.
            if len(sensors) >= 2 and 2 * len(kept) >= len(best.members):
                self.group[sorted(kept)] = len(self.scores)
                self.scores.append(best.score)
                self.radius_km.append(best.radius_km)
            else:
                kept = set()
            self.ambiguous[sorted(set(best.members) - kept)] = True
            self.taken[list(best.members)] = True
