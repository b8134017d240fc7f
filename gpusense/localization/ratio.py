"""Log-likelihood ratio of "the pose is wrong" against "the pose is right" of one scan.

A short beam tells next to nothing: people and furniture shorten beams at right poses as often as walls do at wrong
ones. So the ratio is a function of the beams that meet a mapped wall: T pass through it, A agree with it. With
n = A + S + T beams that tell anything, S of them short,

    r = n / (n + FEW) (BIAS + SLOPE log((T + 1/2) / (A + 1/2))),

within LIMITS: no agreement excludes that another place looks alike. A pose inside of solid cells adds SOLID, one in
unknown cells UNKNOWN. The coefficients are those of a logistic regression on simulated runs
(``bench/studies/verdict_fit.py``): people, moved and new
furniture, glass, wrong maps, 16 to 360 beams and kidnapping, half of the weight for right poses and half for wrong
ones. No recorded log is among them.

Among landmarks the ratio is that of the prediction of features (:mod:`gpusense.localization.evidence`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from gpusense.localization.passages import AGREES, SHORT, THROUGH, Passages

BIAS, SLOPE, FEW = 1.9, 1.75, 4.0
SOLID, UNKNOWN, LIMITS = 2.0, 1.0, (-3.0, 5.0)
# Share of a feature's gain that counts, since features of a scan and of the next one are dependent; its limit.
_OF_GAIN, _LIMIT_OF_GAIN = 0.25, 3.0


def ratio_of_scan(scans: Sequence[Passages]) -> float:
    """Return the ratio of the scans of one moment; NaN where they tell nothing.

    Args:
        scans: Judged beams of each scanner, at one pose.
    """
    if not scans:
        return math.nan
    agree, through, short = (sum(one.count(kind) for one in scans) for kind in (AGREES, THROUGH, SHORT))
    counted = agree + through + short
    place = SOLID * any(one.inside for one in scans) + UNKNOWN * any(one.off for one in scans)
    if not counted and not place:
        return math.nan
    ratio = counted / (counted + FEW) * (BIAS + SLOPE * math.log((through + 0.5) / (agree + 0.5)))
    return min(max(ratio + place, LIMITS[0]), LIMITS[1])


def explained_of_scan(scans: Sequence[Passages]) -> float:
    """Return the share of the beams that agree, of those that the map could explain; NaN without any."""
    agree, through, short = (sum(one.count(kind) for one in scans) for kind in (AGREES, THROUGH, SHORT))
    counted = agree + through + short
    return agree / counted if counted else math.nan


def ratio_of_features(gain: float, count: int, least: float) -> float:
    """Return the ratio of the prediction of features.

    Args:
        gain: Logarithm by which the particles predict the features better than chance [nats].
        count: Number of features.
        least: Gain of a feature at which right and wrong are equally likely [nats].
    """
    if math.isnan(gain):
        return gain
    return min(max(_OF_GAIN * (least * count - gain), -_LIMIT_OF_GAIN), _LIMIT_OF_GAIN)
