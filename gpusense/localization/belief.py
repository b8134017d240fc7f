"""Estimate the belief that a localiser follows a wrong pose, by a hidden Markov model.

The states are "right" (the robot is inside the localiser's distribution) and "wrong" (it is elsewhere). The prior
probability of "wrong" is ``START``. Over n scans and d metres a right pose becomes wrong, by a silent divergence or a
carried robot, with probability ``1 - exp(-(PER_SCAN n + PER_METRE d))``; a wrong pose becomes right with probability
``FOUND`` per scan. While the distribution is wide enough to cover several places, both happen with probability ``WIDE``
per scan.

A scan yields a log-likelihood ratio r of "wrong" against "right". Consecutive ratios are dependent: moved furniture is
wrong in all scans of a room. The ratios are modelled as a first-order autoregressive process; the correlation ``rho =
STAYS exp(-d / LENGTH - turn / TURN)`` falls with the motion between two scans. For normal ratios of equal variance the
exact increment of the log odds is then

    (r_t - rho r_{t-1}) / (1 + rho),

so a standing robot gains almost nothing from its hundredth scan, and a change is detected at once (Hamilton, "A new
approach to the economic analysis of nonstationary time series", *Econometrica* 57 (1989), treats such regimes). A pose
that became wrong since the last scan has another place, and the last ratio says nothing about it. Its share of "wrong"
gets the whole ratio instead, and a rise by D counts as further evidence, since the ratio of a right pose would have
stayed:

    r_t + max(r_t - r_{t-1}, 0) rho / (1 + rho).

Such a place looks like the right one (see below) with probability ``ALIKE (1 - rho)``, since near the last pose its
scan must also repeat the last scan.

Some wrong places look like the right one: scans agree there equally, and are no evidence. ``ALIKE`` is the prior share
of such places among wrong ones, and ``ALIKE_CHOSEN`` among places from a search, which prefers them. Places stop
looking alike at the rates of ``ALIKE_LENGTH`` and ``ALIKE_TURN``. If a share a still looks alike, an increment i of the
log odds becomes

    log(a + (1 - a) e^i),   a <- a / (a + (1 - a) e^i),

and even perfect scans of a short log leave "wrong" at least a share ``ALIKE`` of its prior odds.

A search, for example after a start anywhere, chooses a place because the scans agree with it. This agreement is no new
evidence and counts as repeated from the previous scan. A contradiction counts in full.

Comparisons of the pose with other places of the map (:func:`ratio_of_places`) form a second series of ratios. Given
right or wrong, they count as independent of the scans' ratios, the offset of their fit. Their autocorrelation is the
same.

**Evidence of a scan.** The log-likelihood ratio of "wrong" against "right" comes from the beams of one scan.
A short beam is hardly evidence: people and furniture shorten beams at right poses as often as walls at wrong poses.
Among the beams that meet a mapped wall, T pass through and A agree, C of them within a few centimetres. At a wrong pose
that a filter fitted to a scan beams also agree, but less closely. On a wrong map many beams, N, end in unknown cells or
off the map and are no evidence. Let n = A + S + T be the informative beams, S of them short, and f(a, b) = log((a +
1/2) / (b + 1/2)). The ratio is

    r = n / (n + FEW) (BIAS + SLOPE f(T, A) + BLUNT f(A - C, C) + NOTHING f(N, n)),

within LIMITS, since another place may always look alike. A pose inside solid cells adds SOLID, a pose in unknown cells
UNKNOWN. The coefficients come from a logistic regression on about 450 simulated runs with people, moved and new
furniture, glass, wrong maps, 16 to 360 beams and kidnapping; right and wrong poses have equal weight. 200 other runs
(``bench/results/verdict.md``) yield 2.83, 1.40, 0.62 and 0.40. BIAS is lower by CAUTION, since false alarms cost
more; only CAUTION was chosen on the tuning half of the recorded logs.

**Other places.** On a coarse or old map many beams contradict even the right pose, and a single scan cannot
distinguish a wrong pose from a wrong map. A search of the whole map can. At a wrong pose the scan fits another place
far better: the true place, or on another building's map the best of many. At a right pose it seldom does. The best
place beyond 1 m or 0.5 rad of the pose maximises T log p(z | place) - rho, with the temperature T and the ratio rho of
the place's beams that meet walls. Its lead is

    L = T log p(z | place) - T log p(z | pose),

A scan of K beams has m = T K independent beams. I is 1 if the search found the pose, else 0. If the place were
certainly possible, the ratio of the comparison would be

    q = OF_LEAD min(max(L, NEAREST), FARTHEST) - m / (m + HALF) (BY_CHANCE + IS_FOUND I)

The likelihood of end points prefers places with many walls, even walls that beams pass through: after walls have
moved, one of many rooms fits the scan better than the right pose, although its beams contradict it. Then the map is
wrong, and the lead is meaningless. By rho the place is possible with probability pi = 1 / (1 + e^rho), so for q > 0 the
likelihood ratio is the mean of both cases,

    log(pi e^q + 1 - pi).

For q < 0 it is q: even on a wrong map a wrong pose is seldom among the best. BY_CHANCE is the chance gain of the best
of many places, 0 for a scan without information. OF_LEAD comes from a logistic regression with the scan's ratio as an
offset, on 71 further simulated runs and on the log robotdata4 of Wean Hall, with a fifth of the weight of right poses.
BY_CHANCE and IS_FOUND were chosen on 246 more simulated runs, half of them with 30 % of the walls moved, and on the
tuning half of the recorded logs. The 200 runs, with few doubtful right poses, yield 0.29, 1.6 and 0.0 for the three.

Among landmarks the ratio comes from the prediction of features (:class:`gpusense.localization.verdict.Evidence`).
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
