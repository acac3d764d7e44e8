"""Association of a window by likelihood: which tracklets are one object.

`associate_tracklets` prepares the search and `_Search.run` does it:

1. Samples are sorted by sensor and projected onto planes (`views`), and the behaviour of unrelated
   tracklets is estimated (`chance`).
2. Pairs of sensors are taken in order, the longest baselines first (`search.sensor_pairs`).
3. Two tracklets of a pair are a seed where their lines of sight meet, within their errors, above
   the Earth (`search.seeds`).
4. Tracklets of other sensors join a seed where its points explain them (`search.growth`). The
   result is a hypothesis. Its score is the log-odds against "all of these are unrelated" (`odds`).
   With many sensors, clear hypotheses become groups at once.
5. After the pairs, the probabilities of detection are estimated. If these are lower than assumed,
   more pairs are needed: back to 2.
6. The remaining hypotheses become groups, the likeliest first (`_Search.take`). Two that follow
   each other in time may be merged. Tracklets that two explain about equally well are ambiguous.
7. With many sensors, the tracklets that are left are seeds too, where no pair of 2 has looked
   (`search.leftover_seeds`).
8. A tracklet goes to the group that clearly explains it best (`search.resolve_conflicts`).
9. Groups that are doubtful, now that the number of objects is known, are withdrawn.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.association.chance import (
    CERTAIN_LOG_ODDS,
    chance_of,
    detection_odds,
    estimated_detection,
    looks_of,
    revised_odds,
    sets_of_sensors,
    visible_volumes,
)
from epipole.tasks.algorithms.association.hypothesis_queue import (
    Hypothesis,
    HypothesisQueue,
    distinct,
)
from epipole.tasks.algorithms.association.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.association.search.field_index import cones_of, field_index
from epipole.tasks.algorithms.association.search.growth import grow_all
from epipole.tasks.algorithms.association.search.leftover_seeds import leftover_seeds
from epipole.tasks.algorithms.association.search.merge_hypotheses import best_merger
from epipole.tasks.algorithms.association.search.resolve_conflicts import resolve_conflicts
from epipole.tasks.algorithms.association.search.search_space import SearchSpace, work_space
from epipole.tasks.algorithms.association.search.seeds import seeds_between
from epipole.tasks.algorithms.association.search.sensor_pairs import (
    EveryPair,
    RankedPairs,
    SensorPairs,
    sparse_sensors,
)
from epipole.tasks.algorithms.association.views import views_of
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM

PRIOR_DETECTION = 0.9  # probability of detection before the data are known
FEW_SENSORS = 6  # up to this number, every pair of sensors provides seeds
# Gate of seeds with more sensors: it saves time in crowds, and other pairs seed the objects that it
# rejects. With 1.25 the odds change, with 5 nothing does.
SEED_SIGMA = 2.5
# Maximum expected number of objects without a seed, and log-odds at which a group is accepted
# before the next pair seeds. Half and double make no difference up to 32 sensors.
MAX_UNSEEDED, CLEAR_LOG_ODDS = 0.01, 15.0
MIN_KEPT_LOG_ODDS = -3.0  # minimum log-odds of a hypothesis before the number of objects is known
# Log-odds above which the number of objects cannot make a group doubtful: with 40 all scenes tried
# have the same odds, with 10 a constellation of 32 sensors has others.
DOUBTLESS_LOG_ODDS = 20.0


class Shell(NamedTuple):
    """Altitudes [km above the equatorial radius] of a share of all objects."""

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
        Views of one object agree within this (as a chi-square of the same probability).
    min_altitude_km, max_range_km
        Objects are sought between this altitude and this distance from the Earth's centre.
    min_log_odds
        Minimum log-odds (natural) of a group, against unrelated tracklets.
    ambiguity_log_odds
        If the log-odds of two contradicting groups differ by less, they are rivals: only the
        tracklets that both have are reported, the others are ambiguous.
    shells
        A weak prior on altitude. The share that the shells leave is spread evenly. Without
        shells the prior is uniform.

    Notes
    -----
    Deterministic: no random numbers; ties are decided by the order of sensors and tracklets.
    The cost grows with the number of tracklets times sensors, not with its square: see `seeds`.
    """
    if len(samples.sensor) == 0:
        nothing = np.full(len(samples.half_field), np.nan)
        none = np.zeros(0, bool)
        return Groups(np.zeros(0, np.int64), np.zeros(0), none, none, nothing)
    views, order = views_of(samples)
    cones = cones_of(views)
    space = SearchSpace(
        views=views,
        chance=chance_of(samples, max_range_km, PRIOR_DETECTION),
        taken=np.zeros(len(order), np.bool_),
        shells=_weights(shells, max_range_km).astype(float),
        lowest_km=float(EARTH_RADIUS_KM + min_altitude_km),
        farthest_km=float(max_range_km),
        gate_sigma=float(gate_sigma),
        fields=field_index(cones, float(max_range_km)),
    )
    search = _Search(space, order, ambiguity_log_odds)
    pairs = (
        SensorPairs(views, space.farthest_km, space.fields, cones)
        if search.many
        else EveryPair(space.fields, cones, space.farthest_km)
    )
    return search.run(pairs, min_log_odds)


def _weights(shells: Iterable[Shell], farthest_km: float) -> Array:
    """Return rows (lowest, highest radius, weight): density over that of a uniform spread."""
    rows, rest = [], 1.0
    for lowest, highest, share in shells:
        inner, outer = EARTH_RADIUS_KM + lowest, EARTH_RADIUS_KM + highest
        rows.append((inner, outer, share * farthest_km**3 / (outer**3 - inner**3)))
        rest -= share
    return np.array([*rows, (0.0, np.inf, max(rest, 0.01))] if rows else np.zeros((0, 3)))


class _Search:
    """The hypotheses over one set of samples, and the groups that are accepted.

    `order` gives the sample of each tracklet of the search space; `margin` is the difference in
    log-odds below which two contradicting hypotheses are both doubtful.
    """

    def __init__(self, space: SearchSpace, order: Indices, margin: float) -> None:
        self.space, self.order, self.margin = space, order, float(margin)
        self.work = work_space(space.views)
        self.many = len(space.views.half_field) > FEW_SENSORS
        self.sparse = sparse_sensors(space.views)
        self.group, self.ambiguous = np.full(len(order), FREE), np.zeros(len(order), np.bool_)
        self.in_hypothesis = np.zeros(len(order), np.bool_)  # the tracklet was in any hypothesis
        self.groups: list[Hypothesis] = []

    def run(self, pairs: EveryPair | SensorPairs, min_log_odds: float) -> Groups:
        """Return the groups. With many sensors the clear ones are accepted during the search."""
        waiting: list[Hypothesis] = []
        while (pair := pairs.next(self._enough_pairs())) is not None:
            while pair is not None:
                waiting += self.hypotheses(*pair)
                pair = pairs.next(self._enough_pairs())
            # If sensors miss more than was assumed, more pairs are needed.
            waiting = self._learn_detection(waiting)
        self.take(waiting, MIN_KEPT_LOG_ODDS)
        if isinstance(pairs, SensorPairs):
            self._take_leftover(pairs.ranked)
        nothing_taken = self.space._replace(taken=np.zeros_like(self.space.taken))
        x_km = np.array([h.x_km for h in self.groups]).reshape(-1, 3)
        grouped = self.group != FREE
        resolve_conflicts(nothing_taken, self.work, self.group, x_km)
        self.ambiguous |= grouped & (self.group == FREE)  # two objects explain them as well
        scores = self._withdraw_doubtful(min_log_odds)
        group, ambiguous = np.empty_like(self.group), np.empty_like(self.ambiguous)
        free, undecided = self.group == FREE, np.empty_like(self.ambiguous)
        group[self.order], ambiguous[self.order] = self.group, self.ambiguous & free
        undecided[self.order] = self.in_hypothesis & free & ~self.ambiguous
        return Groups(group, scores, ambiguous, undecided, self.space.chance.detected)

    def _enough_pairs(self) -> float:
        """Return the number of pairs that must cover a point, so that few objects lack a seed.

        A pair misses an object if either sensor does.
        """
        missed = 1 - float(np.mean(self.space.chance.detected)) ** 2
        return float(np.ceil(np.log(MAX_UNSEEDED / max(len(self.groups), 1)) / np.log(missed)))

    def _take_leftover(self, pairs: RankedPairs) -> None:
        """Accept groups of the tracklets that are left, from pairs of sensors that were skipped."""
        seeds = leftover_seeds(self.space, pairs, self._enough_pairs(), self.space.gate_sigma)
        self.take(distinct(self.grow(seeds)[0]), MIN_KEPT_LOG_ODDS)

    def hypotheses(self, a: int, b: int) -> list[Hypothesis]:
        """Return the hypotheses of two sensors' seeds; clear ones become groups at once."""
        gate_sigma = self.space.gate_sigma
        if self.many and not (self.sparse[a] and self.sparse[b]):
            gate_sigma = min(gate_sigma, SEED_SIGMA)
        seeds = seeds_between(self.space, a, b, gate_sigma)
        grown, taken = self.grow(seeds, CLEAR_LOG_ODDS if self.many else np.inf)
        for h, clear in zip(grown, taken, strict=True):
            if clear:
                self._accept(h, h.members)
        return distinct(h for h, clear in zip(grown, taken, strict=True) if not clear)

    def grow(self, seeds: Indices, clear: float = np.inf) -> tuple[list[Hypothesis], list[bool]]:
        """Return the hypotheses of (n, 2) seeds among the free tracklets, and which are clear.

        The tracklets of clear hypotheses are entered in `space.taken`.
        """
        if not len(seeds):
            return [], []
        min_score = MIN_KEPT_LOG_ODDS - self.margin
        grown = grow_all(self.space, self.work, seeds, float(clear), min_score)
        self.in_hypothesis[grown.member] = True
        member, first, first_missed = (
            values.tolist() for values in (grown.member, grown.first_member, grown.first_missed)
        )
        hypotheses = [
            Hypothesis(
                score,
                (a, b),
                tuple(member[first[q] : first[q + 1]]),
                grown.x_km[q],
                grown.missed[first_missed[q] : first_missed[q + 1]],
            )
            for q, (score, (a, b)) in enumerate(
                zip(grown.score.tolist(), seeds[grown.seed].tolist(), strict=True)
            )
        ]
        return hypotheses, grown.taken.tolist()

    def _learn_detection(self, waiting: list[Hypothesis]) -> list[Hypothesis]:
        """Estimate the probabilities of detection; return the hypotheses with their new odds.

        The estimate is from the groups and the certain hypotheses.
        """
        used: set[int] = set()
        sure = []
        for h in sorted(waiting, key=lambda h: (-h.score, h.members)):
            if h.score > CERTAIN_LOG_ODDS and used.isdisjoint(h.members):
                used.update(h.members)
                sure.append(h)
        assumed = self.space.chance.detected
        detected = estimated_detection(self.space.views, [*self.groups, *sure], PRIOR_DETECTION)
        self.space = self.space._replace(chance=self.space.chance._replace(detected=detected))
        self.groups = self._with_detection(self.groups, assumed, detected)
        return self._with_detection(waiting, assumed, detected)

    def _with_detection(
        self, hypotheses: list[Hypothesis], assumed: Array, detected: Array
    ) -> list[Hypothesis]:
        """Return the hypotheses with their odds for other probabilities of detection."""
        looks, n = looks_of(self.space.views, hypotheses), len(hypotheses)
        change = detection_odds(looks, n, detected) - detection_odds(looks, n, assumed)
        return [
            Hypothesis(h.score + more, h.seed, h.members, h.x_km, h.missed)
            for h, more in zip(hypotheses, change.tolist(), strict=True)
        ]

    def _accept(self, h: Hypothesis, members: Iterable[int]) -> None:
        self.group[list(members)] = len(self.groups)
        self.groups.append(h)

    def take(self, hypotheses: list[Hypothesis], min_log_odds: float) -> None:
        """Accept hypotheses, the likeliest first; members that a rival also has are ambiguous."""
        taken = self.space.taken
        # A clear group may have taken some of their tracklets.
        broken = [h for h in hypotheses if taken[list(h.members)].any()]
        intact = [h for h in hypotheses if not taken[list(h.members)].any()]
        queue = HypothesisQueue(intact + self._grow_again(broken))
        while (best := queue.pop()) is not None and best.score >= min_log_odds:
            if taken[list(best.members)].any():
                for again in self._grow_again([best]):
                    queue.push(again)
                continue
            if (
                merged := best_merger(self.space, self.work, best, queue.sharing(best))
            ) is not None:
                queue.push(merged)
                continue
            rivals = queue.rivals(best, self.margin, self.group != FREE)
            kept = set(best.members).intersection(*(h.members for h in rivals))
            sensors = {int(self.space.views.sensor[i]) for i in kept}
            # Only members that all rivals have too are certain. They are accepted if they are at
            # least half of the hypothesis.
            if len(sensors) >= 2 and 2 * len(kept) >= len(best.members):
                self._accept(best, kept)
            else:
                kept = set()
            self.ambiguous[sorted(set(best.members) - kept)] = True
            taken[list(best.members)] = True

    def _grow_again(self, hypotheses: Iterable[Hypothesis]) -> list[Hypothesis]:
        """Return what grows from the free members of hypotheses that have lost others."""
        seeds = [seed for h in hypotheses for seed in self._free_seed(h)]
        return self.grow(np.array(seeds, np.int64).reshape(-1, 2))[0]

    def _free_seed(self, h: Hypothesis) -> list[tuple[int, int]]:
        """Return a seed from which a hypothesis can grow again: its seed if free, or two free
        members of two sensors. Empty if there are none."""
        taken, sensor = self.space.taken, self.space.views.sensor
        if not taken[list(h.seed)].any():
            return [h.seed]
        free = [i for i in h.members if not taken[i]]
        return [(free[0], i) for i in free if sensor[i] != sensor[free[0]]][:1]

    def _withdraw_doubtful(self, min_log_odds: float) -> Array:
        """Withdraw groups that are too unlikely once the number of objects is known.

        Returns the log-odds of the groups that are left.
        """
        scores = self._revise_odds()
        kept = scores >= min_log_odds
        new = np.where(kept, np.cumsum(kept) - 1, FREE)
        member = self.group != FREE
        undecided = ~kept & (scores > -self.margin)
        self.ambiguous[member] |= undecided[self.group[member]]
        self.group[member] = new[self.group[member]]
        return np.asarray(scores[kept])

    def _revise_odds(self) -> Array:
        """Return the groups' log-odds with the number of objects estimated from them."""
        space, scores = self.space, np.array([h.score for h in self.groups])
        if not len(scores) or scores.min() > DOUBTLESS_LOG_ODDS:
            return scores
        anywhere = np.array([[0.0, np.inf, 1.0]])
        shells = space.shells if len(space.shells) else anywhere
        sets = sets_of_sensors(space.views, self.groups)
        volumes = visible_volumes(space.views, sets.sensors, shells, space.farthest_km)
        radius_km = np.linalg.norm([h.x_km for h in self.groups], axis=1)
        return revised_odds(scores, radius_km, shells, sets, volumes, space.chance)
