"""Find doors: gaps in a straight wall that are wide enough for a person or robot, and at least partly open."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.lines import first_apart, pairs_of, scores_of
from gpusense.features.result import Found, turned_axes
from gpusense.features.segments import Beams, Segments

# Least and largest width of a door [m].
_NARROWEST, _WIDEST = 0.5, 2.0
# Largest offset [m] and angle [rad] between both sides of a wall, plus this many deviations.
_ASIDE, _PARALLEL, _DEVIATIONS = 0.03, math.radians(4), 3.0
# Least lengths of a wall and its other side; largest uncertainty of a jamb across and along the wall [m].
_WALL, _OTHER, _VAGUE, _COARSE = 0.5, 0.1, 0.08, 0.4
# Uncertainty of a jamb at grazing incidence [standard deviations of ranges].
_REVEAL = 4.0
# Least shares of the beams between the jambs that reach the wall, without and with a leaf, and that pass through;
# distance behind the wall that counts as through [m].
_UNSTOPPED, _UNSTOPPED_BESIDE_LEAF, _THROUGH, _DEEP = 0.6, 0.25, 0.25, 0.4
# Length of a leaf in widths of its door, its least angle to the wall [rad], and the gap at its hinge [m].
_LEAF, _LEAST_TURN, _TOUCHING = (0.6, 1.25), math.radians(15), 0.12


@dataclass(frozen=True)
class _Gaps:
    """Gaps between two segments of a scan."""

    before: np.ndarray  # (D,) segment before the gap
    after: np.ndarray  # (D,) segment after it
    wall: np.ndarray  # (D,) the segment on the wall, one of these two
    other: np.ndarray  # (D,) the other segment: a part of the wall, or a door leaf
    ends: np.ndarray  # (D, 4) positions of both jambs along the wall, and the distances between beams there [m]

    def only(self, rows: np.ndarray) -> _Gaps:
        """Return some of the gaps."""
        return _Gaps(self.before[rows], self.after[rows], self.wall[rows], self.other[rows], self.ends[rows])


def find_doors(segments: Segments, straight: np.ndarray, beams: Beams, mount: tuple[float, float, float]) -> Found:
    """Return the doors of scans: centre of the gap, direction across, and width."""
    sides = np.flatnonzero(np.isfinite(segments.distance) & (segments.count >= 3))
    one, two = pairs_of(segments.scan[sides])
    # Include pairs across the end of a scan.
    before, after = sides[np.concatenate([one, two])], sides[np.concatenate([two, one])]
    kinds = _between_walls(segments, straight, before, after), _beside_leaves(segments, straight, before, after)
    names = ("before", "after", "wall", "other", "ends")
    gaps = _Gaps(*(np.concatenate([getattr(each, name) for each in kinds]) for name in names))
    is_leaf = np.arange(len(gaps.wall)) >= len(kinds[0].wall)
    good, through = _openness(segments, beams, gaps)
    gaps, is_leaf, through = gaps.only(good), is_leaf[good], through[good]
    kept = _one_each(segments, gaps, straight[gaps.other] & ~is_leaf)
    gaps = gaps.only(kept)
    return _found(segments, gaps.wall, gaps.other, gaps.ends, through[kept], mount)


def _between_walls(segments: Segments, straight: np.ndarray, before: np.ndarray, after: np.ndarray) -> _Gaps:
    """Return the gaps between two parts of a straight wall."""
    # The more certain line is the wall; the other one must continue it.
    wall = np.where(segments.covariance[before, 0, 0] <= segments.covariance[after, 0, 0], before, after)
    other = np.where(wall == before, after, before)
    left, right = _jambs(segments, before, after, wall)
    gaps = _Gaps(before, after, wall, other, np.stack([left[0], right[0], left[1], right[1]], axis=1))
    return gaps.only(_is_wide(segments, straight, gaps) & _on_wall(segments, wall, other))


def _beside_leaves(segments: Segments, straight: np.ndarray, before: np.ndarray, after: np.ndarray) -> _Gaps:
    """Return the gaps between a wall's end and the hinge of a leaf that is open towards the scanner."""
    wall, leaf = np.concatenate([before, after]), np.concatenate([after, before])
    before, after = np.concatenate([before, before]), np.concatenate([after, after])
    near = straight[wall] & straight[leaf]
    wall, leaf, before, after = wall[near], leaf[near], before[near], after[near]
    alpha, beta = segments.angle[wall], segments.angle[leaf]
    sine = np.sin(beta - alpha)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Position of the intersection along each line.
        hinge = (segments.distance[leaf] - segments.distance[wall] * np.cos(beta - alpha)) / sine
        reached = (segments.distance[leaf] * np.cos(beta - alpha) - segments.distance[wall]) / sine
    first = leaf == after
    end = np.where(first, segments.ends[leaf, 0], segments.ends[leaf, 1])
    step = np.where(first, segments.spacing[leaf, 0], segments.spacing[leaf, 1])
    left, right = _jambs(segments, before, after, wall)
    ends = np.stack([np.where(first, left[0], hinge), np.where(first, hinge, right[0]),
                     np.where(first, left[1], step), np.where(first, step, right[1])], axis=1)  # fmt: skip
    gaps = _Gaps(before, after, wall, leaf, ends)
    noise = np.sqrt(segments.variance[wall])
    good = (np.abs(sine) > math.sin(_LEAST_TURN)) & (np.abs(reached - end) <= 1.5 * step + 0.05 + _DEVIATIONS * noise)
    share = segments.length[leaf] / np.maximum(ends[:, 1] - ends[:, 0], 1e-9)
    good &= (share >= _LEAF[0]) & (share <= _LEAF[1])
    return gaps.only(good & _is_wide(segments, straight, gaps))


def _is_wide(segments: Segments, straight: np.ndarray, gaps: _Gaps) -> np.ndarray:
    """Return which gaps are as wide as doors, in a long enough wall, with well-located jambs."""
    width = gaps.ends[:, 1] - gaps.ends[:, 0]
    good = straight[gaps.wall] & (segments.length[gaps.wall] >= _WALL) & (segments.length[gaps.other] >= _OTHER)
    result: np.ndarray = good & (width >= _NARROWEST) & (width <= _WIDEST) & (gaps.ends[:, 2:] <= _COARSE).all(axis=1)
    return result


def _one_each(segments: Segments, gaps: _Gaps, sure: np.ndarray) -> np.ndarray:
    """Choose a door from each overlapping set: long walls on both sides take precedence, then the narrowest."""
    wall, ends = gaps.wall, gaps.ends
    order = np.lexsort((ends[:, 1] - ends[:, 0], ~sure, segments.scan[wall]))
    middle = segments.place(wall, ends[:, :2].mean(axis=1))
    width = ends[:, 1] - ends[:, 0]

    def do_not_overlap(k: int, j: int) -> bool:
        return bool(np.hypot(*(middle[j] - middle[k])) > 0.5 * (width[j] + width[k]))

    return first_apart(order, segments.scan[wall], do_not_overlap)


def _jambs(
    segments: Segments, before: np.ndarray, after: np.ndarray, wall: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return the positions of both jambs along the wall, and the distances between beams there."""
    found = []
    bearing = segments.points.point[:, 2].astype(np.float64)
    for point, side in ((segments.last[before], 1), (segments.first[after], -1)):
        turn = wrapped(bearing[point] - segments.angle[wall])
        turn = np.where(np.abs(turn) < 1.55, turn, np.nan)
        step = segments.distance[wall] * segments.step / np.square(np.cos(turn))
        place = segments.distance[wall] * np.tan(turn) + side * 0.5 * step
        # The part of a jamb's reveal within noise of the wall looks like wall.
        found.append((place, np.hypot(step, _REVEAL * np.sqrt(segments.variance[wall]) * np.sin(turn))))
    return found[0], found[1]


def _on_wall(segments: Segments, wall: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether the other side continues the wall."""
    c, s, d = np.cos(segments.angle[wall]), np.sin(segments.angle[wall]), segments.distance[wall]
    good = np.ones(len(wall), bool)
    deviation = np.sqrt(segments.covariance[wall, 0, 0] + segments.covariance[other, 0, 0])
    turn = np.abs(wrapped(segments.angle[wall] - segments.angle[other]))
    good &= turn <= _PARALLEL + _DEVIATIONS * deviation
    middle = segments.ends[other].mean(axis=1)
    xy = segments.place(other, middle)
    across, along = c * xy[:, 0] + s * xy[:, 1] - d, c * xy[:, 1] - s * xy[:, 0]
    spread = np.sqrt(np.maximum(segments.at(wall, along)[:, 0, 0] + segments.at(other, middle)[:, 0, 0], 0))
    good &= (np.abs(across) <= _ASIDE + _DEVIATIONS * spread) & (spread <= _VAGUE)
    return good


def _openness(segments: Segments, beams: Beams, gaps: _Gaps) -> tuple[np.ndarray, np.ndarray]:
    """Return which gaps are open, and the share of their beams that pass through."""
    points, wall = segments.points, gaps.wall
    scan = segments.scan[wall]
    begin, total = points.start[scan], points.counts[scan]
    last, first = segments.last[gaps.before], segments.first[gaps.after]
    inside = np.mod(first - last - 1, np.maximum(total, 1))
    open_beams = beams.without_return(scan, last, first)
    which = np.repeat(np.arange(len(wall)), inside)
    number = np.arange(len(which)) - np.repeat(np.cumsum(inside) - inside, inside)
    index = begin[which] + (last[which] - begin[which] + 1 + number) % np.maximum(total[which], 1)
    angle = segments.angle[wall][which]
    place = points.point[:, :2].astype(np.float64)
    depth = np.cos(angle) * place[index, 0] + np.sin(angle) * place[index, 1] - segments.distance[wall][which]
    margin = (0.05 + 3 * np.sqrt(segments.variance[wall]))[which]

    def count(chosen: np.ndarray) -> np.ndarray:
        return np.bincount(which[chosen], minlength=len(wall))

    # Beams next to a jamb pass the wall. An object in front of the wall hides the jamb; an object that begins at the
    # jamb is a leaf.
    beside = np.stack([last, first], axis=1)[which]
    at_end = np.stack([number == 0, number == inside[which] - 1], axis=1) & (depth < -margin)[:, None]
    apart = np.hypot(*np.moveaxis(place[index][:, None] - place[beside], 2, 0))
    touches = apart <= _TOUCHING + 2 * gaps.ends[which, 2:]
    hidden, has_leaf = count((at_end & ~touches).any(axis=1)) > 0, count((at_end & touches).any(axis=1)) > 0
    stopped, shallow = count(depth < -margin), count((depth >= -margin) & (depth < _DEEP))
    beams_in = inside + open_beams
    share = np.maximum(beams_in, 1)
    through = np.where(beams_in > 0, (share - stopped - shallow) / share, 0)
    least = np.where(has_leaf, _UNSTOPPED_BESIDE_LEAF, _UNSTOPPED)
    return ~hidden & (1 - stopped / share >= least) & (through >= _THROUGH), through


def _found(
    segments: Segments, wall: np.ndarray, other: np.ndarray, ends: np.ndarray, through: np.ndarray,
    mount: tuple[float, float, float],
) -> Found:  # fmt: skip
    """Return doors from their walls and jambs (D, 4), see ``ends`` of :class:`_Gaps`."""
    angle, middle = segments.angle[wall], ends[:, :2].mean(axis=1)
    # Twice the variance of an edge between two beams: the neighbours of a jamb may be mistaken for its reveal.
    along = np.square(ends[:, 2:]).sum(axis=1) / 24
    covariance = np.zeros((len(wall), 3, 3))
    covariance[:, ::2, ::2], covariance[:, 1, 1] = segments.at(wall, middle), along
    xy = segments.place(wall, middle) + np.array(mount[:2])
    best = np.maximum(scores_of(segments, wall), scores_of(segments, other))
    found = Found(segments.scan[wall], np.column_stack([xy, angle]), turned_axes(angle), covariance,
                  ends[:, 1] - ends[:, 0], best * np.minimum(1, 0.5 + through))  # fmt: skip
    return found.only(np.argsort(found.scan, kind="stable"))
