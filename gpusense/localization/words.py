"""Words for a probability of being lost."""

from __future__ import annotations

from typing import Literal

Word = Literal["tracking", "uncertain", "lost"]
# Probabilities above which a pose is lost, and up to which it is tracked.
LOST, TRACKING = 0.5, 0.2


def word_of(p_lost: float, wrong: float, *, wide: bool) -> Word:
    """Return the word for a probability of being lost.

    Args:
        p_lost: The probability.
        wrong: Probability that another place is right, by the scans.
        wide: Whether the distribution is too wide to have one place.
    """
    if wide or (p_lost > LOST and wrong <= LOST):
        return "uncertain"
    if p_lost > LOST:
        return "lost"
    return "tracking" if p_lost <= TRACKING else "uncertain"
