"""Estimate the belief that a localiser follows a wrong pose, by a hidden Markov model.

The states are "right" (the robot is inside the localiser's distribution) and "wrong" (it is elsewhere). A scan yields a
log-likelihood ratio r of "wrong" against "right". Consecutive ratios are a first-order autoregressive process
(Hamilton, "A new approach to the economic analysis of nonstationary time series", *Econometrica* 57 (1989), treats such
regimes). If a share a of the wrong places still looks like the right one, an increment i of the log odds becomes

    log(a + (1 - a) e^i),   a <- a / (a + (1 - a) e^i).

``docs/background/localization.md`` lists all formulas, their reasons, and the runs behind the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpusense.localization.beam_consistency import BeamConsistency, counts_of

BIAS, SLOPE, BLUNT, NOTHING, FEW = 3.34, 1.74, 0.48, 0.58, 4.0
CAUTION, SOLID, UNKNOWN, LIMITS = 0.9, 2.0, 1.0, (-4.0, 5.0)
# Comparisons with other places: weight and limits of the best place's lead [nats]; its gain by chance; evidence for a
# pose that a search finds; number of independent beams that halves the last two.
OF_LEAD, NEAREST, FARTHEST, BY_CHANCE, IS_FOUND, HALF = 0.44, -4.0, 8.0, 0.9, 1.9, 1.0
# Weight of a feature's gain, since features of successive scans are dependent; limit of the gain.
_OF_GAIN, _LIMIT_OF_GAIN = 0.25, 3.0


def ratio_of_scan(scans: Sequence[BeamConsistency]) -> float:
    """Return the ratio of simultaneous scans, by the judged beams of each scanner; NaN without evidence."""
    return evidence_of_scan(scans)[0]


def evidence_of_scan(scans: Sequence[BeamConsistency]) -> tuple[float, float]:
    """Return the ratio of simultaneous scans, and the agreeing share of their explainable beams; NaN without any."""
    if not scans:
        return math.nan, math.nan
    agree, close, through, short, nothing = counts_of(scans)
    informative = agree + through + short
    place = SOLID * (True in [one.inside for one in scans]) + UNKNOWN * (True in [one.off for one in scans])
    if not informative:
        return (min(max(place, LIMITS[0]), LIMITS[1]) if place else math.nan), math.nan
    ratio = BIAS - CAUTION + SLOPE * _odds(through, agree)
    ratio += BLUNT * _odds(agree - close, close) + NOTHING * _odds(nothing, informative)
    ratio = informative / (informative + FEW) * ratio + place
    return min(max(ratio, LIMITS[0]), LIMITS[1]), agree / informative


def _odds(one: int, other: int) -> float:
    """Return the log odds of two counts, with half a beam added to each."""
    return math.log((one + 0.5) / (other + 0.5))


def ratio_of_places(lead: float, beams: float, walls: float, *, is_found: bool) -> float:
    """Return the ratio from comparing a pose with other places; NaN if neither is possible, or without beams.

    The lead is the tempered log-likelihood of the best other place less the pose's [nats], -inf if a search found none.
    ``beams`` are independent, ``walls`` is the other place's ratio by the beams that meet walls, and ``is_found`` is
    true if the search also found the pose.
    """
    if math.isnan(lead) or not beams > 0:
        return math.nan
    share = beams / (beams + HALF)
    ratio = OF_LEAD * min(max(lead, NEAREST), FARTHEST) - share * (BY_CHANCE + IS_FOUND * is_found)
    return ratio if ratio <= 0 else math.log1p(math.expm1(ratio) / (1 + math.exp(walls)))


def ratio_of_features(gain: float, count: int, least: float) -> float:
    """Return the ratio from predicting features; at the gain ``least`` of each, right is as likely as wrong."""
    if math.isnan(gain):
        return gain
    return min(max(_OF_GAIN * (least * count - gain), -_LIMIT_OF_GAIN), _LIMIT_OF_GAIN)


# Prior probability of "wrong" after a start at a pose. Rates of becoming wrong per scan and per metre, of becoming
# right again, and of both while the distribution is wide.
START = 0.1
PER_SCAN, PER_METRE, FOUND, WIDE = 5e-4, 2e-3, 0.003, 0.05
# Correlation of the ratios of two scans at a place; distance and turn over which it falls to 1 / e [m, rad].
STAYS, LENGTH, TURN = 0.95, 2.0, 1.0
# Prior shares of wrong places that look like the right one; distance and turn over which they fall to 1 / e [m, rad].
ALIKE, ALIKE_CHOSEN, ALIKE_LENGTH, ALIKE_TURN = 0.08, 0.12, 8.0, 2.0
# Searches per wrong result on a right map; largest number of wrong results.
MISSES, MOST_PLACES = 8, 2
# Longest counted motion between scans [m]; a longer motion is a jump of the localiser.
_FASTEST = 1.0


def motion_between(pose: Sequence[float] | np.ndarray, before: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Return distance [m] and turn [rad] between two poses."""
    way = math.hypot(pose[0] - before[0], pose[1] - before[1])
    return way, abs(math.remainder(float(pose[2] - before[2]), math.tau))


def correlation(way: float, turn: float) -> float:
    """Return the correlation of the log-likelihood ratios of two scans separated by this motion."""
    return STAYS * math.exp(-way / LENGTH - turn / TURN)


class Comparison(NamedTuple):
    """Last comparison of the pose with other places; immutable."""

    ratio: float = 0.0  # log-likelihood ratio of "wrong" against "right"
    pose: tuple[float, float, float] | None = None  # compared pose; None before
    chosen: bool = False  # true if scans choose the next pose among many


class Belief(NamedTuple):
    """State of the model; immutable."""

    log_odds: float = math.log(START / (1 - START))  # logarithm of the odds of "wrong"
    ratio: float = 0.0  # log-likelihood ratio of the last judged scan
    pose: tuple[float, float, float] | None = None  # pose of that judgement; None before
    scans: int = 0  # scans since then
    chosen: bool = False  # true if the next pose is one that scans choose among many
    alike: float = ALIKE  # share of "wrong" that looks like "right"
    compared: Comparison = Comparison()  # last comparison of the pose with other places

    @property
    def wrong(self) -> float:
        """Probability of "wrong"."""
        return 1 / (1 + math.exp(-self.log_odds))

    @classmethod
    def anywhere(cls, after: int = 0) -> Belief:
        """Return the belief at a place from a search, after failed ones; on a right map one in ``MISSES`` fails."""
        return cls._chosen(math.log(MISSES) * min(after, MOST_PLACES))

    def counted(self) -> Belief:
        """Return the belief after counting a scan."""
        return Belief(self.log_odds, self.ratio, self.pose, self.scans + 1, *self[4:])

    def widened(self) -> Belief:
        """Return the belief after scans without a tracked pose: the next pose may be anywhere."""
        return self._chosen(self._moved(WIDE, WIDE, min(self.scans, 100))[0])

    @classmethod
    def _chosen(cls, log_odds: float) -> Belief:
        """Return the belief at a place that scans will choose."""
        return cls(log_odds, chosen=True, alike=ALIKE_CHOSEN, compared=Comparison(chosen=True))

    def judged(self, pose: tuple[float, float, float], ratio: float) -> Belief:
        """Return the belief after a scan with a log-likelihood ratio of wrong against right; NaN has no evidence."""
        way, turn, rho = 0.0, 0.0, 0.0
        repeats = self.chosen and ratio < 0
        if self.pose is not None and not repeats:
            way, turn = motion_between(pose, self.pose)
            rho = correlation(way, turn)
        lost = 1 - math.exp(-PER_SCAN * self.scans - PER_METRE * min(way, _FASTEST * self.scans))
        found = 1 - (1 - FOUND) ** self.scans
        if math.isnan(ratio):
            log_odds, alike = self._moved(lost, found, 1)
            return self._replace(log_odds=log_odds, scans=0, alike=alike)
        rise = max(ratio - self.ratio, 0.0) * rho / (1 + rho)
        # The increments of places that were wrong before, and of places that became wrong since.
        new, fresh = new_part(ratio, self.ratio, rho), ratio + rise
        if repeats:
            new = fresh = new_part(ratio, ratio, STAYS)
        alike = self.alike * math.exp(-way / ALIKE_LENGTH - turn / ALIKE_TURN)
        wrong = self.wrong
        stays, added = wrong * (1 - found), (1 - wrong) * lost
        # A place that became wrong since must also repeat the last scan to look alike.
        added_alike = ALIKE * (1 - rho)
        after = stays * _changed(alike, new) + added * _changed(added_alike, fresh)
        log_odds = math.log(after) - math.log1p(-stays - added)
        alike = (stays * alike + added * added_alike) / after
        return Belief(log_odds, ratio, pose, 0, False, alike, self.compared)

    def compared_with(self, pose: tuple[float, float, float], ratio: float) -> Belief:
        """Return the belief after comparing the last judged pose with other places; a ratio of NaN compares nothing."""
        if math.isnan(ratio):
            return self
        last = self.compared
        rho, before = (STAYS, ratio) if last.chosen and ratio < 0 else (0.0, 0.0)
        if not rho and last.pose is not None:
            rho, before = correlation(*motion_between(pose, last.pose)), last.ratio
        change = _changed(self.alike, new_part(ratio, before, rho))
        log_odds = self.log_odds + math.log(change)
        return self._replace(compared=Comparison(ratio, pose), log_odds=log_odds, alike=self.alike / change)

    def _moved(self, lost: float, found: float, times: int) -> tuple[float, float]:
        """Return the log odds, and the share that looks alike, after transitions."""
        wrong, alike = self.wrong, self.alike
        for _ in range(times):
            stays, added = wrong * (1 - found), (1 - wrong) * lost
            wrong = stays + added
            alike = (stays * alike + added * ALIKE) / wrong
        return math.log(wrong) - math.log1p(-wrong), alike


def _changed(alike: float, new: float) -> float:
    """Return the factor of the odds by new evidence [nats], of which places that look alike yield none."""
    return alike + (1 - alike) * math.exp(new)


def new_part(ratio: float, before: float, rho: float) -> float:
    """Return the increment of the log odds from a ratio that has the correlation rho with the ratio before."""
    return (ratio - rho * before) / (1 + rho)
