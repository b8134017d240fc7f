"""Choose the word for the probability of being lost."""

from __future__ import annotations

from typing import Literal

Word = Literal["tracking", "uncertain", "lost"]
WORDS: tuple[Word, ...] = ("tracking", "uncertain", "lost")
# Bounds on the probability of "lost" (above) and "tracking" (up to).
LOST, TRACKING = 0.5, 0.1


def verdict_label(p_lost: float, wrong: float, *, wide: bool, apart: bool) -> Word:
    """Return the word for the probability of being lost.

    Args:
        p_lost: The probability.
        wrong: Probability that another place is right, by the scans.
        wide: True if the distribution is too wide for a tracked pose.
        apart: True if the distribution covers several places, so that scans cannot contradict a single one.
    """
    if wrong > LOST and not apart:
        return "lost"
    return "uncertain" if wide or apart or p_lost > TRACKING else "tracking"
