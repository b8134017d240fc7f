"""Find doors, gaps in a straight wall, and poles, round objects in front of their background."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.lines import first_apart, pairs_of, scores_of
from gpusense.features.result import Found, turned_axes
from gpusense.features.segments import Beams, ScanDevice, Segments

# Least and largest radius [m], and least points of a pole.
_THINNEST, _THICKEST, _LEAST_POINTS = 0.015, 0.5, 4
# Least distance between a pole and its background: this [m] plus this many deviations.
_BEHIND, _DEVIATIONS = 0.08, 6.0
# Larger poles must clearly fit a circle better than lines: radius that counts as one deviation [m].
_USUAL = 0.1
# Largest squared deviations per reading and edge of a pole, and its largest cost beyond its segments' lines.
_POOR, _ROUND = 2.5, 6.0
# Least evidence for a pole; beams on each side for estimating chance, per beam of the pole and at least; and the
# distance between near ranges [deviations].
_LEAST_EVIDENCE, _AROUND, _FEWEST_AROUND, _NEAR = 7.0, 2, 20, 3.0
# Expected noise gain of each further line.
_EACH = 8.0


def find_poles(
    device: ScanDevice, segments: Segments, beams: Beams, noise: np.ndarray, mount: tuple[float, float, float]
) -> Found:
    """Return the poles of scans: centre and radius."""
    first, count, scan, edges = _objects(segments, beams, noise)
    # Sort by bearing from the first segment on, independent of the scan's heading.
    begin = segments.first[np.searchsorted(segments.scan, scan)]
    order = np.lexsort((np.mod(first - begin, segments.points.counts[scan]), scan))
    first, count, scan, edges = first[order], count[order], scan[order], edges[order]
    part = np.stack([first, count], axis=1)
    step = segments.step
    edge = np.column_stack([edges, np.full((len(first), 2), step / math.sqrt(12))])
    circle = device.circles(part, scan, edge)
    radius, cost = circle[:, 2], circle[:, 3]
    good = (cost >= 0) & (radius >= _THINNEST) & (radius <= _THICKEST) & np.isfinite(circle).all(axis=1)
    good &= cost <= _POOR * (count - 1) + 4
    good &= cost + np.square(radius / _USUAL) <= _cost_of_lines(segments, first, count, scan) + _ROUND
    rows = np.flatnonzero(good)
    rows = rows[_evidence(segments, first[rows], count[rows], scan[rows], cost[rows], noise) > _LEAST_EVIDENCE]
    circle, scan, count, cost = circle[rows], scan[rows], count[rows], cost[rows]
    inverse, radius = _covariance(circle), circle[:, 2]
    distance = np.hypot(circle[:, 0], circle[:, 1])
    sure = (np.sqrt(np.einsum("pii->p", inverse)) < 0.5 * np.maximum(radius, 0.05)) & (distance > radius)
    observed = np.zeros((len(scan), 2, 3))
    observed[:, 0, 0] = observed[:, 1, 1] = 1
    pose = np.column_stack([circle[:, :2] + np.array(mount[:2]), np.zeros(len(scan))])
    fit = np.minimum(1, (count - 1) / np.maximum(cost, 1e-9))
    score = np.clip(fit * (1 - np.sqrt(np.einsum("pii->p", inverse)) / np.maximum(radius, 0.05)), 0, 1)
    return Found(scan, pose, observed, inverse, radius, score).only(sure)


def _evidence(
    segments: Segments, first: np.ndarray, count: np.ndarray, scan: np.ndarray, cost: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Return the log-likelihood ratios (P,) of circles to chance, less the logarithm of the candidates per scan.

    By chance, the ranges of an object are independent, with the density of the ranges around it. The density at a range
    is the share of near ranges among the beams on both sides, plus one beam.
    """
    points, result = segments.points, np.zeros(len(first))
    for k, (one, number, of) in enumerate(zip(first.tolist(), count.tolist(), scan.tolist(), strict=True)):
        begin, total, sigma = int(points.start[of]), int(points.counts[of]), float(noise[of])
        place = begin + np.mod(one - begin + np.arange(total), total)
        bearing, r = points.point[place, 2].astype(np.float64), points.point[place, 3].astype(np.float64)
        beams = max(_AROUND * number, _FEWEST_AROUND)
        off = np.mod(np.stack([bearing - bearing[number - 1], bearing[0] - bearing]), 2 * math.pi).min(axis=0)
        around = r[number:][off[number:] <= beams * segments.step]
        near = np.abs(around - r[:number, None]) <= _NEAR * sigma
        density = (near.sum(axis=1) + 1) / (2 * beams * 2 * _NEAR * sigma)
        likelihood = -0.5 * cost[k] - number * math.log(sigma * math.sqrt(2 * math.pi))
        result[k] = likelihood - np.log(density).sum() - math.log(total)
    return result


def _covariance(circle: np.ndarray) -> np.ndarray:
    """Return the covariances (P, 2, 2) of centres for an unknown radius."""
    information = np.zeros((len(circle), 3, 3))
    rows, cols = np.triu_indices(3)
    information[:, rows, cols] = information[:, cols, rows] = circle[:, 4:10]
    inverse: np.ndarray = np.linalg.pinv(information, hermitian=True)[:, :2, :2]
    return inverse


def _objects(
    segments: Segments, beams: Beams, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return first points, numbers of points, scans and bearings of both edges of objects in the foreground."""
    points = segments.points
    total = len(points.point)
    scan = np.repeat(np.arange(len(noise)), points.counts)
    begin, counts = points.start[scan], points.counts[scan]
    following = begin + (np.arange(total) - begin + 1) % np.maximum(counts, 1)
    point = points.point.astype(np.float64)
    r, bearing = point[:, 3], point[:, 2]
    step = np.mod(bearing[following] - bearing, 2 * math.pi)
    jump = _BEHIND + _DEVIATIONS * noise[scan]
    rises, falls = r[following] - r > jump, r - r[following] > jump
    gap = (step > points.gap) | (following == np.arange(total))
    # An object begins where ranges fall, and ends where they rise or beams have no return.
    begins = np.zeros(total, bool)
    begins[following[falls & ~gap]] = True
    begins |= beams.opens_before
    ends, broken = (rises & ~gap) | beams.opens_after, falls | gap
    starts = np.flatnonzero(begins)
    if not len(starts):
        empty = np.zeros(0, np.int64)
        return empty, empty, empty, np.zeros((0, 2))
    stops = np.flatnonzero(ends | broken)
    return _runs(points.start, scan, starts, stops, ends, bearing, segments.step, points.counts)


def _runs(
    start: np.ndarray, scan: np.ndarray, starts: np.ndarray, stops: np.ndarray, ends: np.ndarray, bearing: np.ndarray,
    step: float, counts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return the narrow objects from starting points to the next stops, if these are ends."""
    place = np.searchsorted(stops, starts)
    last = np.where(place < len(stops), stops[np.minimum(place, len(stops) - 1)], -1)
    # Continue across the end of a scan.
    same = (last >= 0) & (scan[np.maximum(last, 0)] == scan[starts])
    head = np.searchsorted(stops, start[scan[starts]])
    wrapped = stops[np.minimum(head, len(stops) - 1)]
    usable = (head < len(stops)) & (scan[wrapped] == scan[starts]) & (wrapped < starts)
    last = np.where(same, last, np.where(usable, wrapped, -1))
    kept = (last >= 0) & ends[np.maximum(last, 0)]
    starts, last = starts[kept], last[kept]
    of = scan[starts]
    count = np.mod(last - starts, np.maximum(counts[of], 1)) + 1
    width = np.mod(bearing[last] - bearing[starts], 2 * math.pi)
    kept = (count >= _LEAST_POINTS) & (width < 2.0)
    starts, last, of, count, width = starts[kept], last[kept], of[kept], count[kept], width[kept]
    edges = np.stack([bearing[starts] - 0.5 * step, bearing[starts] + width + 0.5 * step], axis=1)
    return starts, count, of, edges


def _cost_of_lines(segments: Segments, first: np.ndarray, count: np.ndarray, scan: np.ndarray) -> np.ndarray:
    """Return the cost of each object's lines: residuals, a penalty per further line, and 1 per point off lines."""
    total = segments.points.counts[scan]
    cost = np.zeros(len(first))
    head, tail = np.searchsorted(segments.scan, scan), np.searchsorted(segments.scan, scan, side="right")
    for k in range(len(first)):
        rows = np.arange(head[k], tail[k])
        off = (segments.first[rows] - first[k]) % total[k]
        inner = rows[(off + segments.count[rows] <= count[k])]
        cost[k] = np.maximum(segments.cost[inner], 0).sum() + _EACH * max(len(inner) - 1, 0)
        cost[k] += count[k] - segments.count[inner].sum()
    return cost


# Least and largest width of a door [m].
_NARROWEST, _WIDEST = 0.5, 2.0
# Largest offset [m] and angle [rad] between both sides of a wall, plus this many deviations.
_ASIDE, _PARALLEL, _WALL_DEVIATIONS = 0.03, math.radians(4), 3.0
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
    good = (np.abs(sine) > math.sin(_LEAST_TURN)) & (
        np.abs(reached - end) <= 1.5 * step + 0.05 + _WALL_DEVIATIONS * noise
    )
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
    return first_apart(
        order, segments.scan[wall], lambda k, j: math.dist(middle[j], middle[k]) > 0.5 * (width[j] + width[k])
    )


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
    c, s, d = np.cos(segments.angle[wall]), np.sin(segments.angle[wall]), segments.distance[wall]
    good = np.ones(len(wall), bool)
    deviation = np.sqrt(segments.covariance[wall, 0, 0] + segments.covariance[other, 0, 0])
    turn = np.abs(wrapped(segments.angle[wall] - segments.angle[other]))
    good &= turn <= _PARALLEL + _WALL_DEVIATIONS * deviation
    middle = segments.ends[other].mean(axis=1)
    xy = segments.place(other, middle)
    across, along = c * xy[:, 0] + s * xy[:, 1] - d, c * xy[:, 1] - s * xy[:, 0]
    spread = np.sqrt(np.maximum(segments.at(wall, along)[:, 0, 0] + segments.at(other, middle)[:, 0, 0], 0))
    good &= (np.abs(across) <= _ASIDE + _WALL_DEVIATIONS * spread) & (spread <= _VAGUE)
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
