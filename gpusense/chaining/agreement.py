"""Find matches of places that agree with each other, the evidence for a revisited place.

Two matches T1 and T2 between the same passages agree if they and the paths along both passages form a closed loop. A
match counts only while enough matches that agree with it also count. Across a break of the chain, and beyond the
expected drift, the drift cannot confirm a match, and a group needs more evidence.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.links import Links
from gpusense.chaining.motion import relative
from gpusense.localization.pose_algebra import compose_poses, invert_poses, wrap_angle

# Least number of agreeing matches, including the match.
_AGREE = 3
# Necessary evidence of a group, the sum of -log10(1 - p_right) with clamped p_right: in general, and if 1 % of weak
# steps are breaks; largest p_right; different scans on both sides.
EVIDENCE, EVIDENCE_OVER_WEAK, _MOST_RIGHT, _SCANS = 6.5, 4.5, 0.999, 3
# Largest distance between compared matches on both sides [m], and in key scans; matches of a batch.
_PASSAGE, _KEYS, _MATCHES = 8.0, 64, 1024
# Largest gap of a closed loop of two matches [m, rad], and its growth with the path [m/m, rad/m].
_MISSED, _MISSED_TURN, _SHARE, _SHARE_TURN = 0.15, 0.03, 0.03, 0.01
_NONE = np.zeros(0, np.int64)


def agreeing(matches: Links, poses: Floats, needed: Floats) -> Flags:
    """Return the mask (L,) of matches that enough other matches of the same passages support.

    ``needed`` (L,) is the necessary evidence of a match's group; 0: none.
    """
    if not len(matches):
        return np.zeros(0, bool)
    table = _consistent(matches, poses)
    kept = np.ones(len(matches), bool)
    while True:
        kept = _supported(table, kept)
        lone = kept & (needed > 0)
        group, evidence, scans = _groups(table, lone, matches)
        lone[lone] = (evidence[group] < needed[lone]) | (scans[group] < _SCANS)
        if not lone.any():
            return kept
        kept = kept & ~lone


def _supported(table: Any, kept: Flags) -> Flags:
    """Return the mask (L,) of matches that agree with enough supported matches."""
    while True:
        fewer = kept & (table @ kept.astype(np.int64) >= _AGREE - 1)
        if (fewer == kept).all():
            return kept
        kept = fewer


def _groups(table: Any, kept: Flags, matches: Links) -> tuple[Integers, Floats, Integers]:
    """Group the kept matches that agree directly or through others.

    Returns (K,) group of each, (G,) evidence of each group, and (G,) different scans on the side with fewer.
    """
    from scipy.sparse.csgraph import connected_components

    rows = np.flatnonzero(kept)
    if not len(rows):
        return _NONE, np.zeros(0), _NONE
    count, found = connected_components(table[rows][:, rows], directed=False)
    group: Integers = np.asarray(found, np.int64)
    evidence = np.bincount(group, -np.log10(1 - np.minimum(matches.p_right[rows], _MOST_RIGHT)), count)
    scans = [
        np.bincount(np.unique(np.stack([group, ends[rows]]), axis=1)[0], minlength=count)
        for ends in (matches.first, matches.second)
    ]
    return group, evidence.astype(np.float64), np.minimum(*scans).astype(np.int64)


def _consistent(matches: Links, poses: Floats) -> Any:
    """Return a sparse matrix (L, L), 1 where two matches of the same passages close a loop."""
    from scipy import sparse

    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    rows, cols = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for here, near in _neighbours(matches, path):
        first, second = matches.first, matches.second
        there = compose_poses(matches.pose[here], relative(poses, second[here], second[near]))
        back = compose_poses(invert_poses(matches.pose[near]), relative(poses, first[near], first[here]))
        off = compose_poses(there, back)
        along = sum(np.abs(path[end[here]] - path[end[near]]) for end in (first, second))
        closes = np.hypot(off[:, 0], off[:, 1]) <= _MISSED + _SHARE * along
        closes &= np.abs(wrap_angle(off[:, 2])) <= _MISSED_TURN + _SHARE_TURN * along
        rows.append(here[closes])
        cols.append(near[closes])
    row, col = np.concatenate(rows), np.concatenate(cols)
    return sparse.csr_matrix((np.ones(len(row), np.int64), (row, col)), shape=(len(matches), len(matches)))


def _neighbours(matches: Links, path: Floats) -> Iterator[tuple[Integers, Integers]]:
    """Yield pairs of matches of the same passages in batches: both orders, without pairs that share a scan."""
    first, second = matches.first, matches.second
    order = np.argsort(second, kind="stable")
    scans = second[order]
    begin = np.searchsorted(scans, np.maximum(np.searchsorted(path, path - _PASSAGE), np.arange(len(path)) - _KEYS))
    end = np.searchsorted(
        scans, np.minimum(np.searchsorted(path, path + _PASSAGE, "right"), np.arange(len(path)) + _KEYS + 1)
    )
    for part in range(0, len(matches), _MATCHES):
        some = order[part : part + _MATCHES]
        low, count = begin[second[some]], (end - begin)[second[some]]
        here = np.repeat(some, count)
        near = order[np.repeat(low - np.cumsum(count) + count, count) + np.arange(len(here))]
        apart = np.abs(path[first[here]] - path[first[near]]) <= _PASSAGE
        apart &= (np.abs(first[here] - first[near]) <= _KEYS) & (second[here] != second[near])
        yield here[apart], near[apart]
