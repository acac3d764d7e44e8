"""Association by likelihood: the hypothesis that explains most, best first.

Two tracklets of two sensors whose lines of sight meet, within their errors, above the Earth,
begin a hypothesis; other sensors' tracklets that its points explain join it; hypotheses are
weighed against "all of these are different things" and taken best first. What two hypotheses
explain about equally well is not decided but called ambiguous.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.chance import Chance, chance_of
from epipole.tasks.algorithms.association.evidence.detection import (
    CERTAIN_LOG_ODDS,
    detection_odds,
    estimated_detection,
)
from epipole.tasks.algorithms.association.evidence.object_density import (
    revised_odds,
    visible_volume,
)
from epipole.tasks.algorithms.association.evidence.pool import Hypothesis, Pool, distinct
from epipole.tasks.algorithms.association.hypotheses.contests import settle_contests
from epipole.tasks.algorithms.association.hypotheses.growth import clear_of_doubt, grow_all
from epipole.tasks.algorithms.association.hypotheses.seeds import SensorPairs, seeds_between
from epipole.tasks.algorithms.association.sampling.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.association.sampling.views import views_of
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM

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
        nothing = np.full(len(samples.half_field), np.nan)
        return Groups(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, bool), nothing)
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
        self.chance, self.gate_sigma, self.limits = chance, float(gate_sigma), np.array(limits)
        self.shells, self.margin = shells.astype(float), float(margin)
        self.many = len(self.views.half_field) > FEW_SENSORS
        n = len(self.order)
        self.taken = np.zeros(n, np.bool_)
        self.group, self.ambiguous = np.full(n, FREE), np.zeros(n, np.bool_)
        self.groups: list[Hypothesis] = []

    def run(self, min_log_odds: float) -> Groups:
        """Return the groups: with many sensors the clear ones at once, the others at the end."""
        pairs = SensorPairs(self.views, float(self.limits[1]))
        waiting: list[Hypothesis] = []
        while (pair := pairs.next(self._enough_pairs())) is not None:
            while pair is not None:
                waiting += self.hypotheses(*pair)
                pair = pairs.next(self._enough_pairs())
            # Where sensors miss more than was thought, more pairs are needed.
            waiting = self._learn_detection(waiting)
        self.take(waiting, WORTH_A_LOOK)
        settle_contests(self.views, self.chance, self.group, len(self.groups), self.gate_sigma)
        scores = self._withdraw_doubtful(min_log_odds)
        group, ambiguous = np.empty_like(self.group), np.empty_like(self.ambiguous)
        group[self.order], ambiguous[self.order] = self.group, self.ambiguous
        return Groups(group, scores, ambiguous & (group == FREE), self.chance.detected)

    def _enough_pairs(self) -> float:
        """Return how many pairs must look at a place until no object there is likely unseeded.

        A pair misses an object where either sensor did. With few sensors: all.
        """
        if not self.many:
            return np.inf
        missed = 1 - float(np.mean(self.chance.detected)) ** 2
        return float(np.ceil(np.log(UNSEEDED / max(len(self.groups), 1)) / np.log(missed)))

    def hypotheses(self, a: int, b: int) -> list[Hypothesis]:
        """Return what the pairs of two sensors' tracklets grow into, beside clear groups."""
        gate_sigma = min(self.gate_sigma, SEED_SIGMA) if self.many else self.gate_sigma
        lowest, farthest = self.limits.tolist()
        seeds = seeds_between(self.views, a, b, self.taken, lowest, farthest, gate_sigma)
        clear = CLEAR_LOG_ODDS if self.many else np.inf
        out = []
        for h in self.grow(seeds, clear):
            if clear_of_doubt(self.chance, h.looks, len(h.members), h.score, clear):
                self._accept(h, h.members)
            else:
                out.append(h)
        return distinct(out)

    def grow(self, seeds: Indices, clear: float = np.inf) -> list[Hypothesis]:
        """Return what (n, 2) seeds grow into among the tracklets that are free.

        All tracklets of a clear hypothesis are taken then.
        """
        n, n_sensors = len(seeds), len(self.views.half_field)
        sizes, scores, x_km = np.zeros(n, np.int64), np.empty(n), np.empty((n, 3))
        looks = np.zeros((n, n_sensors), np.int8)
        # More than two fragments a sensor are not kept; the next span has them again.
        grown = np.empty((n, min(2 * n_sensors, len(self.taken))), np.int64)
        grow_all(
            self.views, self.chance, seeds, self.taken, self.limits, self.gate_sigma, self.shells,
            float(clear), (sizes, scores, x_km, looks, grown),
        )  # fmt: skip
        worth = np.flatnonzero((sizes > 0) & (scores > WORTH_A_LOOK - self.margin))
        return [
            Hypothesis(
                float(scores[q]),
                tuple(seeds[q].tolist()),
                tuple(sorted(grown[q, : sizes[q]].tolist())),
                x_km[q],
                looks[q],
            )
            for q in worth
        ]

    def _learn_detection(self, waiting: list[Hypothesis]) -> list[Hypothesis]:
        """Estimate how likely sensors detect, from the surest; return all with their new odds."""
        used: set[int] = set()
        sure = []
        for h in sorted(waiting, key=lambda h: (-h.score, h.members)):
            if h.score > CERTAIN_LOG_ODDS and used.isdisjoint(h.members):
                used.update(h.members)
                sure.append(h)
        believed = self.chance.detected
        detected = estimated_detection(self.views, [*self.groups, *sure], DETECTED)
        self.chance = self.chance._replace(detected=detected)
        self.groups = _with_detection(self.groups, believed, detected)
        return _with_detection(waiting, believed, detected)

    def _accept(self, h: Hypothesis, members: Iterable[int]) -> None:
        self.group[sorted(members)] = len(self.groups)
        self.groups.append(h)

    def take(self, hypotheses: list[Hypothesis], min_log_odds: float) -> None:
        """Accept hypotheses, best first; what rivals contest is ambiguous."""
        # Nearly all of what clear groups took from is nothing without it.
        stale = [h for h in hypotheses if self.taken[list(h.members)].any()]
        afresh = self.grow(np.array([h.seed for h in stale], np.int64).reshape(-1, 2))
        gone = set(map(id, stale))
        pool = Pool([h for h in hypotheses if id(h) not in gone] + afresh)
        while (best := pool.pop()) is not None and best.score >= min_log_odds:
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
                self._accept(best, kept)
            else:
                kept = set()
            self.ambiguous[sorted(set(best.members) - kept)] = True
            self.taken[list(best.members)] = True

    def _withdraw_doubtful(self, min_log_odds: float) -> Array:
        """Withdraw groups that are not sure enough once the number of objects is known.

        Returns the log-odds of those that are left.
        """
        scores = self._revised()
        kept = scores >= min_log_odds
        new = np.where(kept, np.cumsum(kept) - 1, FREE)
        member = self.group != FREE
        undecided = ~kept & (scores > -self.margin)
        self.ambiguous[member] |= undecided[self.group[member]]
        self.group[member] = new[self.group[member]]
        return np.asarray(scores[kept])

    def _revised(self) -> Array:
        scores = np.array([h.score for h in self.groups])
        if not len(scores) or scores.min() > BEYOND_DOUBT:
            return scores
        anywhere = np.array([[0.0, np.inf, 1.0]])
        shells = self.shells if len(self.shells) else anywhere
        volume = visible_volume(self.views, shells, float(self.limits[1]))
        radius_km = np.linalg.norm([h.x_km for h in self.groups], axis=1)
        return revised_odds(scores, radius_km, shells, volume, self.chance)


def _with_detection(
    hypotheses: list[Hypothesis], believed: Array, detected: Array
) -> list[Hypothesis]:
    """Return the hypotheses with the odds that they have with other detection probabilities."""
    if not hypotheses:
        return []
    looks = np.array([h.looks for h in hypotheses])
    change = detection_odds(looks, detected) - detection_odds(looks, believed)
    return [
        replace(h, score=h.score + float(more)) for h, more in zip(hypotheses, change, strict=True)
    ]
