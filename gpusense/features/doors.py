"""Doors: gaps in a straight wall that a person or robot fits through, open at least in part."""

from __future__ import annotations

import math

import numpy as np

from gpusense.features.beams import Beams
from gpusense.features.hallways import pairs_of, wrapped
from gpusense.features.lines import scores_of
from gpusense.features.result import Found
from gpusense.features.segments import Segments

# Width of a door [m].
_NARROWEST, _WIDEST = 0.5, 2.0
# Both sides are of one wall up to this [m] and [rad], and this many deviations.
_ASIDE, _PARALLEL, _DEVIATIONS = 0.03, math.radians(4), 3.0
# Least length of a wall [m] and of its other side, and most uncertainty of a jamb across and along the wall [m].
_WALL, _OTHER, _VAGUE, _COARSE = 0.5, 0.1, 0.08, 0.4
# Uncertainty of a jamb at grazing incidence in deviations of ranges, as a step of beams.
_REVEAL = 4.0
# Share of the beams between the jambs that nothing stops before the wall, and that go on by this [m].
_UNSTOPPED, _THROUGH, _DEEP = 0.6, 0.25, 0.4


def find_doors(segments: Segments, straight: np.ndarray, beams: Beams, mount: tuple[float, float, float]) -> Found:
    """Return the doors of scans: centre of the gap, direction across, and width."""
    sides = np.flatnonzero(np.isfinite(segments.distance) & (segments.count >= 3))
    one, two = pairs_of(segments.scan[sides])
    before, after = _ordered(segments, sides[one], sides[two])
    # The better line is the wall; the other one has to lie on it.
    wall = np.where(segments.covariance[before, 0, 0] <= segments.covariance[after, 0, 0], before, after)
    other = np.where(wall == before, after, before)
    left, right = _jambs(segments, before, after, wall)
    width = right[0] - left[0]
    good = straight[wall] & (segments.length[wall] >= _WALL) & (segments.length[other] >= _OTHER)
    good &= (width >= _NARROWEST) & (width <= _WIDEST) & (left[1] <= _COARSE) & (right[1] <= _COARSE)
    good &= _on_wall(segments, wall, other)
    before, after, wall, other = before[good], after[good], wall[good], other[good]
    ends = np.stack([left[0][good], right[0][good], left[1][good], right[1][good]], axis=1)
    open_share, through = _openness(segments, beams, before, after, wall)
    good = (open_share >= _UNSTOPPED) & (through >= _THROUGH)
    wall, other, ends, through = wall[good], other[good], ends[good], through[good]
    kept = _one_each(segments, wall, ends, straight[other])
    return _found(segments, wall[kept], other[kept], ends[kept], through[kept], mount)


def _one_each(segments: Segments, wall: np.ndarray, ends: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Return the doors of which no other one overlaps, or that have long walls on both sides or are narrower."""
    order = np.lexsort((ends[:, 1] - ends[:, 0], ~sure, segments.scan[wall]))
    middle = segments.place(wall, ends[:, :2].mean(axis=1))
    width = ends[:, 1] - ends[:, 0]
    scan = segments.scan[wall]
    kept: list[int] = []
    taken: list[int] = []
    for k in order.tolist():
        if taken and scan[taken[0]] != scan[k]:
            taken = []
        if all(np.hypot(*(middle[j] - middle[k])) > 0.5 * (width[j] + width[k]) for j in taken):
            taken.append(k)
            kept.append(k)
    return np.array(kept, np.int64)


def _ordered(segments: Segments, one: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sides of gaps: the segment before and the segment after it, also around the end of a scan."""
    around = segments.successor[np.searchsorted(segments.scan, segments.scan[one], side="right") - 1] >= 0
    before = np.concatenate([one, two[around]])
    after = np.concatenate([two, one[around]])
    return before, after


def _jambs(
    segments: Segments, before: np.ndarray, after: np.ndarray, wall: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return places of both jambs along the wall, and the steps of beams there."""
    found = []
    bearing = segments.points.point[:, 2].astype(np.float64)
    for point, side in ((segments.last[before], 1), (segments.first[after], -1)):
        turn = wrapped(bearing[point] - segments.angle[wall])
        turn = np.where(np.abs(turn) < 1.55, turn, np.nan)
        step = segments.distance[wall] * segments.step / np.square(np.cos(turn))
        place = segments.distance[wall] * np.tan(turn) + side * 0.5 * step
        # Of the reveal of a jamb, what is not farther from the wall than noise seems to be wall.
        found.append((place, np.hypot(step, _REVEAL * np.sqrt(segments.variance[wall]) * np.sin(turn))))
    return found[0], found[1]


def _on_wall(segments: Segments, wall: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether the other side lies on the wall."""
    c, s, d = np.cos(segments.angle[wall]), np.sin(segments.angle[wall]), segments.distance[wall]
    good = np.ones(len(wall), bool)
    deviation = np.sqrt(segments.covariance[wall, 0, 0] + segments.covariance[other, 0, 0])
    turn = np.abs(wrapped(segments.angle[wall] - segments.angle[other]))
    good &= turn <= _PARALLEL + _DEVIATIONS * deviation
    middle = segments.ends[other].mean(axis=1)
    xy = segments.place(other, middle)
    across, along = c * xy[:, 0] + s * xy[:, 1] - d, c * xy[:, 1] - s * xy[:, 0]
    mine, its = segments.covariance[wall], segments.covariance[other]
    spread = mine[:, 1, 1] - 2 * along * mine[:, 0, 1] + along**2 * mine[:, 0, 0]
    spread += its[:, 1, 1] - 2 * middle * its[:, 0, 1] + middle**2 * its[:, 0, 0]
    spread = np.sqrt(np.maximum(spread, 0))
    good &= (np.abs(across) <= _ASIDE + _DEVIATIONS * spread) & (spread <= _VAGUE)
    return good


def _openness(
    segments: Segments, beams: Beams, before: np.ndarray, after: np.ndarray, wall: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of the beams of a gap that are not stopped before the wall, and that go through."""
    points, scan = segments.points, segments.scan[wall]
    begin, total = points.start[scan], points.counts[scan]
    last, first = segments.last[before], segments.first[after]
    inside = np.mod(first - last - 1, np.maximum(total, 1))
    open_beams = beams.without_return(scan, last, first)
    which = np.repeat(np.arange(len(wall)), inside)
    number = np.arange(len(which)) - np.repeat(np.cumsum(inside) - inside, inside)
    index = begin[which] + (last[which] - begin[which] + 1 + number) % np.maximum(total[which], 1)
    angle = segments.angle[wall][which]
    xy = points.point[index, :2].astype(np.float64)
    depth = np.cos(angle) * xy[:, 0] + np.sin(angle) * xy[:, 1] - segments.distance[wall][which]
    margin = 0.05 + 3 * np.sqrt(segments.variance[wall])
    # Beside a jamb beams go on; where something stands before it, the jamb is none.
    is_end = (number == 0) | (number == inside[which] - 1)
    hidden = np.bincount(which[is_end & (depth < -margin[which])], minlength=len(wall)) > 0
    stopped = np.bincount(which[depth < -margin[which]], minlength=len(wall))
    shallow = np.bincount(which[(depth >= -margin[which]) & (depth < _DEEP)], minlength=len(wall))
    total = np.maximum(inside + open_beams, 1)
    through = (total - stopped - shallow) / total
    return np.where(hidden, 0, 1 - stopped / total), np.where(inside + open_beams > 0, through, 0)


def _found(
    segments: Segments, wall: np.ndarray, other: np.ndarray, ends: np.ndarray, through: np.ndarray,
    mount: tuple[float, float, float],
) -> Found:  # fmt: skip
    """Return doors by their walls and jambs (D, 4): places along the wall and steps of beams."""
    angle, middle = segments.angle[wall], ends[:, :2].mean(axis=1)
    c, s = np.cos(angle), np.sin(angle)
    mine = segments.covariance[wall]
    # Twice the variance of an edge between two beams: beams beside a jamb may be taken for its reveal.
    along = np.square(ends[:, 2:]).sum(axis=1) / 24
    across = mine[:, 1, 1] - 2 * middle * mine[:, 0, 1] + middle**2 * mine[:, 0, 0]
    mixed = mine[:, 0, 1] - middle * mine[:, 0, 0]
    covariance = np.zeros((len(wall), 3, 3))
    covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 2, 2] = across, along, mine[:, 0, 0]
    covariance[:, 0, 2] = covariance[:, 2, 0] = mixed
    observed = np.zeros((len(wall), 3, 3))
    observed[:, 0, 0], observed[:, 0, 1] = c, s
    observed[:, 1, 0], observed[:, 1, 1], observed[:, 2, 2] = -s, c, 1
    xy = segments.place(wall, middle) + np.array(mount[:2])
    best = np.maximum(scores_of(segments, wall), scores_of(segments, other))
    found = Found(segments.scan[wall], np.column_stack([xy, angle]), observed, covariance,
                  ends[:, 1] - ends[:, 0], best * np.minimum(1, 0.5 + through))  # fmt: skip
    return found.only(np.argsort(found.scan, kind="stable"))
