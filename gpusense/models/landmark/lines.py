"""The line model: straight pieces of scans against a map of walls, by angle and distance, with the ends free."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Association, Precision
from gpusense.backends import Selection
from gpusense.interface.flags import flags_if
from gpusense.interface.plan import Omission
from gpusense.interface.structs import FeatureTerms
from gpusense.models.landmark.base import JOINT_FEATURES, FeatureModel
from gpusense.models.landmark.features import PreparedFeatures
from gpusense.models.landmark.line_features import possible_lines, prepare_lines
from gpusense.models.landmark.plan import common_omissions
from gpusense.models.landmark.sampling import draw_lines
from gpusense.models.landmark.tables import uploaded
from gpusense.models.point.sampling import draws_at
from gpusense.world.frames import split
from gpusense.world.landmarks import LandmarkMap, make_buckets
from gpusense.world.line_map import LineMap
from gpusense.world.sensor_parameters import LineParameters


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
        return cast(np.ndarray, self._evaluate(poses, features, correspondence, out=out)[0])

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
        return draw_lines(
            draws, partners, self.lines, self.parameters, self.mount, every=correspondence is not None
        )  # fmt: skip

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
