"""Match successive scans from the odometry or from rest, and retry doubtful matches from neighbouring motions.

Rest is a poor guess for a robot that moves far between scans without odometry: along a corridor, where scans look
alike everywhere, the match stays at its guess. Doubtful matches, and motions unlike their neighbours, are therefore
also tried from constant motion. The match with the highest ``p_right``, which falls with the distance from the guess,
is taken.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.matcher import SURE, Matcher
from gpusense.localization.pose_algebra import wrap_angle
from gpusense.matching.result import ScanMatch

# Half widths of a second search after a failed one [m, rad].
_WIDE = (2.0, math.pi)
# Least p_right of a match beyond doubt; least difference of unlike motions [m, rad].
_BEYOND, _UNLIKE, _UNLIKE_TURN = 0.9, 0.25, 0.1
# Most rounds of constant motion, each from the good motions of the previous one.
_ROUNDS = 4


def matched_again(matcher: Matcher, found: ScanMatch, first: Integers, second: Integers, guess: Floats) -> ScanMatch:
    """Retry failed matches (L,) from the motions before and after, and in a wide window, and return all matches."""
    for attempt in ("before", "after", "wide"):
        good = found.usable & (found.p_right >= SURE)
        rows = np.flatnonzero(~good)
        if not len(rows):
            break
        others = guess[rows]
        if attempt != "wide":
            near = np.flatnonzero(good)
            if not len(near):
                continue
            place = np.searchsorted(near, rows) - (attempt == "before")
            others = found.pose[near[np.clip(place, 0, len(near) - 1)]]
        found = _tried(matcher, found, rows, first, second, others, _WIDE if attempt == "wide" else None)
    return found


def matched_by_motion(
    matcher: Matcher, found: ScanMatch, first: Integers, second: Integers, last: Floats | None
) -> tuple[ScanMatch, Floats]:
    """Retry doubtful matches from rest by neighbouring motions and by the usual motion.

    Returns all matches, and (L, 3) offsets to a second possible motion, NaN without one. ``last`` is the motion before
    the first pair, or None.
    """
    seen = [found]
    for _ in range(_ROUNDS):
        good = found.usable & (found.p_right >= _BEYOND) & (found.eigenvalues > 0).all(axis=1)
        around = motions_around(found.pose, good, last)
        off = found.pose - around[2]
        far = (np.hypot(off[:, 0], off[:, 1]) > _UNLIKE) | (np.abs(wrap_angle(off[:, 2])) > _UNLIKE_TURN)
        rows = np.flatnonzero(~good | far)
        if not len(rows):
            break
        before = found.pose
        usual = np.median(found.pose[good], axis=0) if good.any() else np.zeros(3)
        for motion in (*around, np.broadcast_to(usual, found.pose.shape)):
            again = matcher.match(first[rows], second[rows], motion[rows])
            seen.append(found.replaced(rows, again, again.usable & (again.p_right >= SURE)))
            found = found.replaced(rows, again, _is_better(found, rows, again))
        if np.array_equal(before, found.pose):
            break
    return found, _rivals(found, seen)


def _rivals(found: ScanMatch, seen: list[ScanMatch]) -> Floats:
    """Return offsets (L, 3) to the most probable rival poses along directions that both observe; NaN without one."""
    rival, best = np.full((len(found), 3), np.nan), np.zeros(len(found))
    for other in seen:
        off = other.pose - found.pose
        off[:, 2] = wrap_angle(off[:, 2])
        # A direction that a match does not observe is no evidence.
        scale = np.stack([np.ones(len(off)), np.ones(len(off)), found.lever], axis=1)
        along = np.abs(np.einsum("lij,lj->li", found.directions, off * scale)) * (found.eigenvalues > 0)
        apart = (along.max(axis=1) > _UNLIKE) & other.usable & (other.p_right >= SURE) & (other.p_right > best)
        rival[apart], best[apart] = off[apart], other.p_right[apart]
    return rival


def weakened(information: Floats, offset: Floats) -> Floats:
    """Return information (L, 3, 3) that spans rivals at offsets (L, 3), by Woodbury's identity; NaN: no rival."""
    offset = np.where(np.isfinite(offset), offset, 0.0)
    side = np.einsum("lij,lj->li", information, offset)
    total = 4 + (side * offset).sum(axis=1)
    result: Floats = information - side[:, :, None] * (side / total[:, None])[:, None, :]
    return result


def motions_around(motion: Floats, good: Flags, last: Floats | None) -> tuple[Floats, Floats, Floats]:
    """Return the last good motion before each, the next good motion, and their mean, each (L, 3).

    A side without a good motion takes the other side's, or rest. ``last`` is the motion before the first one, or None.
    """
    motion = np.concatenate([np.zeros((1, 3)) if last is None else last[None], motion])
    near, rows = np.flatnonzero(np.append(last is not None, good)), np.arange(1, len(motion))
    if not len(near):
        rest = np.zeros((len(rows), 3))
        return rest, rest, rest
    before, after = np.searchsorted(near, rows) - 1, np.searchsorted(near, rows, "right")
    alone = (before < 0) & (after == len(near))
    before, after = np.where(before < 0, after, before), np.where(after < len(near), after, before)
    one, two = (
        np.where(alone[:, None], 0.0, motion[near[np.minimum(side, len(near) - 1)]]) for side in (before, after)
    )
    return one, two, 0.5 * (one + two)


def _tried(
    matcher: Matcher, found: ScanMatch, rows: Integers, first: Integers, second: Integers, guess: Floats,
    window: tuple[float, float] | None,
) -> ScanMatch:  # fmt: skip
    """Retry some matches from new guesses, and return all matches, replaced where p_right is higher."""
    again = matcher.match(first[rows], second[rows], guess, window)
    return found.replaced(rows, again, _is_better(found, rows, again))


def _is_better(found: ScanMatch, rows: Integers, again: ScanMatch) -> Flags:
    """Return whether new matches of some pairs become usable, or have a higher p_right."""
    usable, before = again.usable, found.usable[rows]
    better: Flags = (usable & ~before) | ((usable == before) & (again.p_right > found.p_right[rows]))
    return better
