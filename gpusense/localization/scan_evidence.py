"""Log-likelihood ratio of "the pose is wrong" against "the pose is right" for one scan.

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
    """Return the ratio from comparing a pose with other places of the map.

    Args:
        lead: Tempered log-likelihood of the best other place less the pose's [nats]; -inf if a search found none; NaN
            if neither is possible.
        beams: Number of independent beams, the temperature times the number of beams.
        walls: Ratio of the scan at the other place, by the beams that meet walls.
        is_found: Whether the search also found the pose.

    Returns:
        The ratio; NaN if neither place nor pose is possible, or without beams.
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
