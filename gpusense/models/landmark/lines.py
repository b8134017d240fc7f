"""The line model: straight pieces of scans against a map of walls, by angle and distance, with the ends free."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Association, Precision
from gpusense.backends import Selection
from gpusense.interface import feature_layout as at
from gpusense.interface.constants import log_weight
from gpusense.interface.flags import flags_if
from gpusense.interface.plan import Omission
from gpusense.interface.structs import FeatureTerms
from gpusense.models.landmark.base import JOINT_FEATURES, FeatureModel, common_omissions
from gpusense.models.landmark.features import LOW_PARTS, PreparedFeatures, in_two_parts, read_table, uploaded
from gpusense.models.landmark.sampling import draw_lines
from gpusense.models.point.sampling import draws_at
from gpusense.world.frames import Mount, split
from gpusense.world.landmarks import LandmarkMap, LineMap, make_buckets
from gpusense.world.sensor_parameters import LARGEST_ANGLE_DEVIATION, LineParameters


class LineModel(FeatureModel):
    """log p(f | x, m) of straight lines that a scan shows, by the walls that they may belong to.

    A line is ``x cos(angle) + y sin(angle) = distance`` in the robot's frame; its angle is the direction of the normal
    that points away from the scanner. Each adds ``log(z_detect p(f | j) + z_false / (2 pi range_max))`` with a normal
    density p(f | j) of angle and distance; docs/landmarks.md defines it. A line may be a wall if its projection on the
    wall overlaps it. Otherwise the places of the ends do not matter, since a scan shows only the visible part of a
    wall. The wall j is known from ``correspondence``, or chosen by ``association``.

    Args:
        lines: The map.
        parameters: Deviations and weights.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        association: The rule for lines without a known wall. ``"nearest"`` takes the likeliest wall of each;
            ``"sum"`` sums over all walls, each with the prior 1 / M; ``"joint"`` takes the likeliest assignment in
            which no two lines that overlap have the same wall, for at most 8 lines and 1024 walls.
        mount: Pose (x, y, yaw) of the features' frame on the robot [m, m, rad]; ``extract_features`` returns lines in
            the robot's frame.
        temperature: In (0, 1]: multiplies the sum over lines.
        specialize: False to run every part of the kernels, with the same results at lower speed.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> corridor = gs.LineMap([(0, 0, 10, 0), (0, 2, 10, 2)])
        >>> model = gs.LineModel(corridor, backend="numpy")
        >>> poses = [(5.0, 1.0, 0.0), (5.0, 1.2, 0.0)]  # the wall to the left is 0.8 m away
        >>> int(model.log_likelihood(poses, [(np.pi / 2, 0.8)]).argmax())
        1
    """

    _angles: ClassVar[tuple[int, str]] = (0, "features: angles")

    def __init__(
        self,
        lines: LineMap,
        parameters: LineParameters | None = None,
        *,
        backend: Selection = "auto",
        precision: Precision = "float32",
        association: Association = "nearest",
        mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
        temperature: float = 1.0,
        specialize: bool = True,
    ) -> None:
        self.lines = checks.instance("lines", lines, LineMap)
        self.parameters = checks.or_default("parameters", parameters, LineParameters)
        super().__init__(
            "lines", len(lines), backend, precision, association=association, mount=mount, temperature=temperature,
            specialize=specialize,
        )  # fmt: skip
        for name in ("sigma_angle", "sigma_distance"):
            self._check_scale(name, getattr(self.parameters, name))
        self._buckets = make_buckets(LandmarkMap(lines.middles))
        order, half = self._buckets.index, 0.5 * lines.lengths
        self._longest = float(half.max(initial=0.0))
        high, low = split(lines.normals[order], self._real)
        normal = np.stack([high[:, 0], low[:, 0], high[:, 1], low[:, 1]], axis=1)
        signature = np.zeros((len(lines), 4))
        signature[:, 0], signature[:, 1] = half[order], lines.two_sided[order]
        (limit,), (rest,) = split(np.array([self.parameters.range_max]), self._real)
        terms = FeatureTerms(limit, rest, 0.0, 0.0)
        self._tables = uploaded(self._backend, self._real, self._buckets, normal, signature, terms)

    @property
    def corners(self) -> np.ndarray:
        """(2 M, 2) ends of the lines [m]; their bounding box contains the map."""
        return self.lines.segments.reshape(-1, 2)

    def log_likelihood(
        self, poses: AnyArray, features: ArrayLike, correspondence: ArrayLike | None = None, *, out: Any = None
    ) -> np.ndarray:
        """Return log p(f_1 ... f_F | x, m) for each particle, natural logarithm.

        A line is left out if its angle or distance is NaN, if its distance is below 0 or beyond range_max, or if its
        angle has a deviation beyond 0.349 rad (20 degrees).

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array of any library, like scans.
            features: (F, 2) angle of the normal [rad] and distance [m]; or (F, 4) with the places of both ends along
                the line, from the foot of the normal, positive to the left of it [m]; or (F, 7) with the variance of
                the angle, the covariance and the variance of the distance, added to the model's:
                ``extract_features(...).lines()``. Missing or NaN ends overlap every wall.
            correspondence: None, or (F,) indices of the walls, -1 for a false positive.
            out: The array for the result, in the memory of the poses.

        Returns:
            (N,) log-likelihoods in the model's precision: densities in 1 / (rad m) for each line.

        Raises:
            TypeError: An argument does not hold numbers, or indices that are no integers.
            ValueError: A wrong shape, a pose that is not finite, a covariance that is not positive semidefinite, an
                index outside the map, or more than 8 lines for a joint association.
        """
        return self._evaluate(poses, features, correspondence, out=out)[0]

    def sample(
        self, poses: AnyArray, seed: int = 0, *, step: int = 0, correspondence: ArrayLike | None = None
    ) -> np.ndarray:
        """Draw lines from p(f | x, m) at each pose, on the host in float64; see ``BeamModel.sample``.

        Without ``correspondence``, every wall that faces the sensor, with a part within range_max, yields a line with
        probability p_detect. Walls hide nothing. With ``correspondence``, each listed wall yields a line. A line is a
        false positive, uniform in angle and distance, with probability z_false.

        Args:
            poses: (N, 3) or (S, N, 3) robot poses in the world [m, m, rad].
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, 0 to 2^31 - 1; each step has different random numbers.
            correspondence: None, or (F,) indices of walls, -1 for a false positive.

        Returns:
            (N, M, 4) or (N, F, 4) angles [rad], distances and places of the ends [m]; (S, N, ...) for S scans. A NumPy
            array of float64, NaN for lines that are not detected or lie beyond the limits; ``log_likelihood`` leaves
            them out.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, a seed or step beyond its limits, or an index outside
                the map.

        Example:
            >>> import gpusense as gs
            >>> model = gs.LineModel(gs.LineMap([(0, 2, 4, 2), (4, 2, 4, -2)]), backend="numpy")
            >>> model.sample([(1.0, 0.0, 0.0)] * 5, seed=1).shape
            (5, 2, 4)
        """
        draws, partners = draws_at(poses, self._backend, seed, step), self._partners(correspondence)
        return draw_lines(draws, partners, self.lines, self.parameters, self.mount, every=correspondence is not None)

    def _describe(self) -> tuple[str, list[Omission]]:
        return f"line model, {self.association}", common_omissions(self.mount, self.precision)

    def _possible(self, features: object) -> tuple[np.ndarray, np.ndarray]:
        return possible_lines(features, self.parameters)

    def _numbers(self, full: np.ndarray, known: bool) -> PreparedFeatures:
        return prepare_lines(
            full, self.parameters, self.mount, self._real, extent=max(self._buckets.shape) * self._buckets.resolution,
            longest=self._longest, gated=self._specialize and not known,
            grouped=JOINT_FEATURES if self.association == "joint" else 0,
        )  # fmt: skip

    def _code(self, prepared: PreparedFeatures, known: bool, each: bool) -> frozenset[str]:
        return self._flags | flags_if(
            RANGE=True, BEARING=True, LINE=True, KNOWN=known, MARGINAL=not known and self.association == "sum",
            PER_BEAM=each,
        )  # fmt: skip


# ---- lines of scans for a device: checks, and the numbers of the kernels


ANGLE, DISTANCE, FIRST, LAST, ANGLE_VARIANCE, MIXED, DISTANCE_VARIANCE = range(7)
# Distance assumed for unknown ends [m].
_UNKNOWN_END = 1e9
# Gates are widened by this share, for rounding errors.
_WIDER = 1e-5
# Two features may belong to the same line if their angles differ by less than this [rad].
_ALIKE = 0.5


def possible_lines(features: object, p: LineParameters) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, 7) lines, all NaN where impossible or not measured, and (F,) whether they are impossible."""
    # Angle and distance; and the ends; and the covariance.
    full = read_table(features, (2, 4, 7))
    unknown = np.isnan(full[:, [FIRST, LAST]]).any(axis=1)
    full[:, FIRST] = np.where(unknown, -_UNKNOWN_END, full[:, [FIRST, LAST]].min(axis=1))
    full[:, LAST] = np.where(unknown, _UNKNOWN_END, full[:, [FIRST, LAST]].max(axis=1))
    covariance = full[:, ANGLE_VARIANCE:]
    covariance[np.isnan(covariance).any(axis=1)] = 0.0
    _check_covariances(covariance)
    missing = np.isnan(full[:, :FIRST]).any(axis=1)
    deviation = np.sqrt(covariance[:, 0] + p.sigma_angle**2)
    bad = np.isinf(full).any(axis=1) | (deviation > LARGEST_ANGLE_DEVIATION)
    bad |= (full[:, DISTANCE] < 0) | (full[:, DISTANCE] > p.range_max)
    full[bad | missing] = np.nan
    return full, bad & ~missing


def _check_covariances(covariance: np.ndarray) -> None:
    """Refuse variances and covariance (F, 3) of a matrix that is not positive semidefinite."""
    one, both, other = covariance.T
    with np.errstate(over="ignore", invalid="ignore"):
        wrong = (one < 0) | (other < 0) | (np.square(both) > one * other * (1 + 1e-9))
    index = np.flatnonzero(wrong)
    if len(index):
        got = checks.show(covariance[index[0]].tolist())
        raise ValueError(f"features: covariance must be positive semidefinite, got {got} at index {index[0]}")


@dataclass(frozen=True)
class _Whitened:
    """Covariances of features by Cholesky's factor: the exponent is (a da)^2 + (b da + c dr)^2."""

    a: np.ndarray  # (K,) factor of the angle
    b: np.ndarray  # (K,) factor of the angle in the second root
    c: np.ndarray  # (K,) factor of the distance
    slope: np.ndarray  # (K,) change of the expected distance with the angle [m/rad]
    spread: np.ndarray  # (K,) standard deviation of the distance [m]


def _whitened(features: np.ndarray, p: LineParameters) -> _Whitened:
    """Return the covariance of features: the measured one plus the model's, at the middle of the visible part."""
    middle = 0.5 * (features[:, FIRST] + features[:, LAST])
    one = features[:, ANGLE_VARIANCE] + p.sigma_angle**2
    both = features[:, MIXED] + middle * p.sigma_angle**2
    slope = both / one
    # The model's part first: the contribution of the lever cancels.
    across = p.sigma_distance**2 + (middle - slope) ** 2 * p.sigma_angle**2
    measured = features[:, DISTANCE_VARIANCE] - 2 * slope * features[:, MIXED] + slope**2 * features[:, ANGLE_VARIANCE]
    rest = across + np.maximum(measured, 0.0)
    a, c = np.sqrt(0.5 / one), np.sqrt(0.5 / rest)
    return _Whitened(a, -slope * c, c, slope, np.sqrt(rest + slope**2 * one))


def prepare_lines(
    features: np.ndarray,
    p: LineParameters,
    mount: Mount,
    real: np.dtype,
    *,
    extent: float,
    longest: float,
    gated: bool,
    grouped: int,
) -> PreparedFeatures:
    """Return the numbers of (F, 7) possible lines, NaN where left out.

    ``extent``: largest coordinate of the map in its buckets' frame [m]; ``longest``: half the longest line of the map
    [m]; ``gated``: whether to bound the lines that can matter; ``grouped``: most features among which overlaps are
    searched.
    """
    columns = np.flatnonzero(~np.isnan(features[:, ANGLE]))
    kept = features[columns]
    w = _whitened(kept, p)
    uniform = -math.log(2 * math.pi) - math.log(p.range_max)
    false = np.where(np.isnan(features[:, ANGLE]), 0.0, log_weight(p.z_false) + uniform)
    angle = kept[:, ANGLE] + mount[2]
    numbers = np.zeros((len(columns), at.FEATURE))
    numbers[:, at.RANGE_AT] = kept[:, DISTANCE]
    numbers[:, at.COSINE], numbers[:, at.SINE] = np.cos(angle), np.sin(angle)
    numbers[:, at.BEARING_SCALE], numbers[:, at.MIXED_SCALE], numbers[:, at.RANGE_SCALE] = w.a, w.b, w.c
    numbers[:, at.PEAK] = log_weight(p.z_detect) + np.log(w.a * w.c / math.pi)
    numbers[:, at.FALSE_POSITIVE] = false[columns]
    numbers[:, at.FIRST_END], numbers[:, at.LAST_END] = kept[:, FIRST], kept[:, LAST]
    numbers[:, at.RANGE_SPREAD] = math.sqrt(0.5) / w.spread
    if len(kept) <= grouped:
        numbers[:, at.GROUP] = _groups(kept)
    _gate(numbers, kept, w, p, real, extent=extent, longest=longest, gated=gated)
    rounded = in_two_parts(numbers, real, LOW_PARTS)
    return PreparedFeatures(columns, rounded, np.ones((len(columns), 3), bool), false)


def _gate(
    numbers: np.ndarray, kept: np.ndarray, w: _Whitened, p: LineParameters, real: np.dtype, *, extent: float,
    longest: float, gated: bool,
) -> None:  # fmt: skip
    """Write the bounds of the lines whose density is at least eps / e of a false positive's.

    The middle of such a line is in a disc around the foot of the feature's normal: some point of the feature between
    its ends is opposite to a point of the line.
    """
    # The mass of the distance is least for a line at the sensor or at range_max.
    mass = np.vectorize(math.erf, otypes=[float])(p.range_max * numbers[:, at.RANGE_SPREAD])
    with np.errstate(divide="ignore"):
        highest = numbers[:, at.PEAK] - np.log(0.5 * mass)
    smallest = numbers[:, at.FALSE_POSITIVE] + math.log(np.finfo(real).eps) - 1
    exponent = np.where(np.isneginf(highest), -np.inf, highest - smallest) if gated else np.full(len(kept), np.inf)
    root = np.sqrt(np.maximum(exponent, 0.0))
    turn = np.minimum(root / w.a, math.pi)
    end = np.abs(kept[:, [FIRST, LAST]]).max(axis=1, initial=0)
    off = root / w.c + np.abs(w.slope) * turn
    reach = kept[:, DISTANCE]
    radius = longest + end * (1 + np.sin(turn)) + off + reach * (1 - np.cos(turn))
    radius = np.where(turn < math.pi / 2, radius, np.inf)
    slack = 16 * np.finfo(real).eps * (extent + 2 * p.range_max)
    numbers[:, at.REACH] = reach
    numbers[:, at.RADIUS] = np.where(exponent < 0, -1.0, radius * (1 + _WIDER) + slack)
    numbers[:, at.AXIS] = np.where(turn < math.pi / 2, np.cos(turn * (1 + _WIDER) + _WIDER), -2.0)


def _groups(kept: np.ndarray) -> np.ndarray:
    """Return the group of each feature; features that overlap, directly or through a chain, share a group.

    Features of one line overlap if the projection of one on the other shares a part with it, and their angles are
    similar.
    """
    from scipy.sparse.csgraph import connected_components

    if not len(kept):
        return np.zeros(0)
    angle, distance = kept[:, ANGLE], kept[:, DISTANCE]
    turn = angle[:, None] - angle
    ends = [distance[:, None] * np.sin(turn) + kept[:, [e]] * np.cos(turn) for e in (FIRST, LAST)]
    low, high = np.minimum(*ends), np.maximum(*ends)
    common = (low < kept[:, LAST]) & (high > kept[:, FIRST]) & (np.cos(turn) > math.cos(_ALIKE))
    return connected_components(common | common.T, directed=False)[1].astype(float)
