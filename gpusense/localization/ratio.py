"""Log-likelihood ratio of "the pose is wrong" against "the pose is right" for one scan.

A short beam is hardly evidence: people and furniture shorten beams at right poses as often as walls do at wrong poses.
Of the beams that meet a mapped wall, T pass through it and A agree with it, C of them to within a few centimetres.
Where a filter has fitted a wrong pose to a scan, beams also agree, but less closely. On a wrong map many beams, N, end
in unknown cells or off the map and give no evidence. With n = A + S + T informative beams, S of them short, and f(a, b)
= log((a + 1/2) / (b + 1/2)),

    r = n / (n + FEW) (BIAS + SLOPE f(T, A) + BLUNT f(A - C, C) + NOTHING f(N, n)),

within LIMITS, since no agreement excludes that another place looks alike. A pose inside solid cells adds SOLID, a pose
in unknown cells UNKNOWN. The coefficients come from a logistic regression on about 450 simulated runs: people, moved
and new furniture, glass, wrong maps, 16 to 360 beams and kidnapping, half of the weight for right poses and half for
wrong ones. 200 other runs (``bench/studies/verdict_fit.py``) give 2.83, 1.40, 0.62 and 0.40. BIAS is lower by CAUTION,
since false alarms cost more; CAUTION alone was chosen on the tuning half of the recorded logs.

**Other places.** On a coarse or old map many beams contradict the right pose as well, and the ratio of the scan alone
cannot tell a wrong pose from a wrong map. A search of the whole map can. At a wrong pose the scan fits another place
far better: the robot's own, or on the map of another building the best of many. At a right pose it seldom does. Of the
places beyond 1 m or 0.5 rad of the pose, the one that explains the scan best maximises T log p(z | place) - rho, with
the temperature T and the ratio rho of the beams that meet walls there. With its lead

    L = T log p(z | place) - T log p(z | pose),

m = T K independent beams of a scan of K, and I = 1 where the pose is itself among the places that the search has found,
else 0, the ratio of a comparison would be

    q = OF_LEAD min(max(L, NEAREST), FARTHEST) - m / (m + HALF) (BY_CHANCE + IS_FOUND I)

if the place were possible. The likelihood of end points prefers places with many walls, also those that beams pass
through: where walls have moved, one of many rooms fits the scan better than the right pose, and is contradicted by its
beams as well. Then the map is wrong, and the lead says nothing. By rho the place is possible with probability
pi = 1 / (1 + e^rho), so for q > 0 the likelihood ratio is the mean of both cases,

    log(pi e^q + 1 - pi).

For q < 0 it is q: also on a wrong map a wrong pose is seldom among the best. BY_CHANCE is what the best of many places
gains by chance, which is nothing for a scan without information. OF_LEAD comes from a logistic regression with the
ratio of the scan as an offset, on 71 simulated runs other than those above and on one log, robotdata4 of Wean Hall,
which has a fifth of the weight of right poses. BY_CHANCE and IS_FOUND were chosen on 246 more simulated runs, half of
them with 30 % of the walls moved, and on the tuning half of the recorded logs. The 200 runs alone, few of whose right
poses are doubtful, give 0.29, 1.6 and 0.0 for the three.

Among landmarks the ratio is that of the prediction of features (:mod:`gpusense.localization.evidence`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from gpusense.localization.passages import Counts, Passages, counts_of

BIAS, SLOPE, BLUNT, NOTHING, FEW = 3.34, 1.74, 0.48, 0.58, 4.0
CAUTION, SOLID, UNKNOWN, LIMITS = 0.9, 2.0, 1.0, (-4.0, 5.0)
# Comparisons with other places: weight and limits of the lead of the best one [nats]; what it gains by chance; evidence
# for a pose that a search finds; number of independent beams at which the last two are half of this.
OF_LEAD, NEAREST, FARTHEST, BY_CHANCE, IS_FOUND, HALF = 0.44, -4.0, 8.0, 0.9, 1.9, 1.0
# Share of a feature's gain that counts, since features of successive scans are dependent; its limit.
_OF_GAIN, _LIMIT_OF_GAIN = 0.25, 3.0


def ratio_of_scan(scans: Sequence[Passages]) -> float:
    """Return the ratio of simultaneous scans; NaN if they give no evidence.

    Args:
        scans: Judged beams of each scanner, at one pose.
    """
    return evidence_of_scan(scans)[0]


def evidence_of_scan(scans: Sequence[Passages]) -> tuple[float, float]:
    """Return the ratio of simultaneous scans, and the share of agreeing beams; see the functions of each."""
    if not scans:
        return math.nan, math.nan
    counts = counts_of(scans)
    telling = counts.telling
    return _ratio_of(counts, scans), counts.agree / telling if telling else math.nan


def _ratio_of(counts: Counts, scans: Sequence[Passages]) -> float:
    """Return the ratio of scans with these counts."""
    place = SOLID * any(one.inside for one in scans) + UNKNOWN * any(one.off for one in scans)
    telling = counts.telling
    if not telling and not place:
        return math.nan
    ratio = BIAS - CAUTION + SLOPE * _odds(counts.through, counts.agree)
    ratio += BLUNT * _odds(counts.agree - counts.close, counts.close) + NOTHING * _odds(counts.nothing, telling)
    return min(max(telling / (telling + FEW) * ratio + place, LIMITS[0]), LIMITS[1])


def _odds(one: int, other: int) -> float:
    """Return the log odds of two counts, with half a beam added to each."""
    return math.log((one + 0.5) / (other + 0.5))


def explained_of_scan(scans: Sequence[Passages]) -> float:
    """Return the share of agreeing beams among those that the map could explain; NaN without any."""
    return evidence_of_scan(scans)[1]


def ratio_of_places(lead: float, beams: float, walls: float, *, is_found: bool) -> float:
    """Return the ratio of a comparison of a pose with other places of the map.

    Args:
        lead: Log-likelihood, times the temperature, of the best other place less that at the pose [nats]; -inf
            where a search found none; NaN where neither is possible.
        beams: Number of independent beams, the temperature times the number of beams.
        walls: Ratio of the scan at the other place, by the beams that meet walls.
        is_found: Whether the search also found the pose.

    Returns:
        The ratio; NaN where neither place nor pose is possible, or without beams.
    """
    if math.isnan(lead) or not beams > 0:
        return math.nan
    share = beams / (beams + HALF)
    ratio = OF_LEAD * min(max(lead, NEAREST), FARTHEST) - share * (BY_CHANCE + IS_FOUND * is_found)
    return ratio if ratio <= 0 else math.log1p(math.expm1(ratio) / (1 + math.exp(walls)))


def ratio_of_features(gain: float, count: int, least: float) -> float:
    """Return the ratio of the prediction of features.

    Args:
        gain: Gain of the particles over chance in predicting the features [nats].
        count: Number of features.
        least: Gain per feature at which right and wrong are equally likely [nats].
    """
    if math.isnan(gain):
        return gain
    return min(max(_OF_GAIN * (least * count - gain), -_LIMIT_OF_GAIN), _LIMIT_OF_GAIN)
