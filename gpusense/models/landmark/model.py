"""The landmark model, *Probabilistic Robotics* section 6.6: features against a map of landmarks."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Association, Precision
from gpusense.backends import Selection
from gpusense.backends.base import Buffer
from gpusense.interface.constants import log_weight
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Program, launch
from gpusense.interface.plan import Omission
from gpusense.interface.structs import Buckets, SensorView
from gpusense.models.landmark.base import FeatureModel, parameter_omissions
from gpusense.models.landmark.features import (
    PreparedFeatures,
    describe,
    full_circle,
    possible_features,
    prepare_features,
    upload_tables,
)
from gpusense.models.landmark.sampling import draw_features
from gpusense.models.point.sampling import draws_at
from gpusense.models.poses import PlacedPoses
from gpusense.world.landmarks import LandmarkMap, make_buckets
from gpusense.world.parameters import LandmarkParameters


class LandmarkModel(FeatureModel):
    """log p(f | x, m) of the features that a sensor detects, by the landmarks that they may belong to.

    Each feature adds ``log(z_detect p(f | j) + z_false p_uniform(f))``; docs/landmarks.md defines both
    densities. The landmark j is known from ``correspondence``, or chosen by ``association`` (tables 6.4 and 6.5).
    Signatures of features are ignored where ``sigma_signature`` of the parameters is None (the default).

    Args:
        landmarks: The map.
        parameters: Deviations, weights and limits of the sensor.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        association: The rule for features without a known landmark. ``"nearest"`` takes the likeliest landmark of each
            feature (the book's maximum likelihood); ``"sum"`` sums over all landmarks, each with the prior 1 / M;
            ``"joint"`` takes the likeliest assignment in which no two features have the same landmark, for at most 8
            features and 1024 landmarks.
        negative: Whether landmarks in view without a feature add ``log(1 - p_detect)`` each; not with ``"sum"``.
        mount: The sensor's pose (x, y, yaw) on the robot [m, m, rad].
        temperature: In (0, 1]: multiplies the sum over features. 1 is the book's plain product.
        specialize: False to run every part of the kernels, with the same results at lower speed.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs
        >>> landmarks = gs.LandmarkMap([(2.0, 0.0), (0.0, 3.0)])
        >>> model = gs.LandmarkModel(landmarks, backend="numpy")
        >>> poses = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0)]
        >>> int(model.log_likelihood(poses, [(1.5, 0.0)]).argmax())
        1
    """

    _angles: ClassVar[tuple[int, str]] = (1, "features: bearings")

    def __init__(
        self,
        landmarks: LandmarkMap,
        parameters: LandmarkParameters | None = None,
        *,
        backend: Selection = "auto",
        precision: Precision = "float32",
        association: Association = "nearest",
        negative: bool = False,
        mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
        temperature: float = 1.0,
        specialize: bool = True,
    ) -> None:
        self.landmarks = checks.instance("landmarks", landmarks, LandmarkMap)
        self.parameters = checks.or_default("parameters", parameters, LandmarkParameters)
        p = self.parameters
        if p.sigma_signature is not None and landmarks.signatures is None:
            raise ValueError(f"sigma_signature: must be None for a map without signatures, got {p.sigma_signature}")
        self.negative = self._negative = checks.boolean("negative", negative)
        if negative and checks.choice("association", association, ("nearest", "sum", "joint")) == "sum":
            raise ValueError("association: must be 'nearest' or 'joint' with negative=True, got 'sum'")
        super().__init__(
            "landmarks", len(landmarks), backend, precision, association=association, mount=mount,
            temperature=temperature, specialize=specialize,
        )  # fmt: skip
        self._sensor = describe(p, landmarks)
        tiny, most = np.finfo(self._real).tiny, np.finfo(self._real).max
        if any(scale and not tiny <= scale <= most for scale in self._sensor.scales):
            raise ValueError(f"parameters: deviations must fit {self._real.name}, got {p}")
        self._buckets = make_buckets(landmarks)
        self._tables = upload_tables(self._backend, self._real, landmarks, self._buckets, p, self._sensor)

    @property
    def corners(self) -> np.ndarray:
        """(M, 2) positions of the landmarks [m]; their bounding box contains the map."""
        return self.landmarks.xy

    def log_likelihood(
        self, poses: AnyArray, features: ArrayLike, correspondence: ArrayLike | None = None, *, out: Any = None
    ) -> np.ndarray:
        """Return log p(f_1 ... f_F | x, m) for each particle, natural logarithm.

        A feature is left out if none of its parts was measured, or if a part is outside the sensor's limits.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array of any library, like scans.
            features: (F, 2) ranges [m] and bearings [rad], or (F, 3) with signatures, which count where
                ``sigma_signature`` is a number; NaN for parts not measured.
            correspondence: None, or (F,) indices of the landmarks of the features, -1 for a false positive.
            out: The array for the result, in the memory of the poses.

        Returns:
            (N,) log-likelihoods in the model's precision: densities in 1/m, 1/rad and 1/unit of the signature for
            the measured parts.

        Raises:
            TypeError: An argument does not hold numbers, or indices that are no integers.
            ValueError: A wrong shape, a pose that is not finite, an index outside the map, or more than 8
                features for a joint association.
        """
        return self._evaluate(poses, features, correspondence, out=out)[0]

    def _arguments(self) -> dict[str, Any]:
        return super()._arguments() | {"negative": self.negative}

    def sample(
        self, poses: AnyArray, seed: int = 0, *, step: int = 0, correspondence: ArrayLike | None = None
    ) -> np.ndarray:
        """Draw features from p(f | x, m) at each pose, on the host in float64; see ``BeamModel.sample``.

        Without ``correspondence``, each landmark within range_max and the field of view is detected with probability
        p_detect. With it, each listed landmark yields a feature. A feature is a false positive, uniform within the
        sensor's limits, with probability z_false. Given their correspondence, features have the density of
        ``log_likelihood``.

        Args:
            poses: (N, 3) or (S, N, 3) robot poses in the world [m, m, rad].
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, 0 to 2^31 - 1; each step has different random numbers.
            correspondence: None, or (F,) indices of landmarks, -1 for a false positive.

        Returns:
            (N, M, 2) or (N, F, 2) ranges [m] and bearings [rad], (N, M, 3) with signatures where ``sigma_signature`` is
            a number; (S, N, ...) for S scans. A NumPy array of float64. Parts without a deviation are NaN, and so are
            all parts of a feature that is not detected or lies beyond the sensor's limits; ``log_likelihood`` leaves
            these features out.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, a seed or step beyond its limits, or an index outside
                the map.

        Example:
            >>> import gpusense as gs
            >>> model = gs.LandmarkModel(gs.LandmarkMap([(2.0, 0.0), (0.0, 3.0)]), backend="numpy")
            >>> model.sample([(0.0, 0.0, 0.0)] * 5, seed=1).shape
            (5, 2, 2)
        """
        draws, partners = draws_at(poses, self._backend, seed, step), self._partners(correspondence)
        return draw_features(
            draws, partners, self.landmarks, self.parameters, self._sensor.span, self.mount,
            every=correspondence is not None,
        )  # fmt: skip

    def _describe(self) -> tuple[str, list[Omission]]:
        omissions = parameter_omissions(self.parameters, self.negative, self.mount, self.precision)
        return f"landmark model, {self.association}", omissions

    def _possible(self, features: object) -> tuple[np.ndarray, np.ndarray]:
        return possible_features(features, self.parameters, self._sensor.span)

    def _numbers(self, full: np.ndarray, known: bool) -> PreparedFeatures:
        return prepare_features(
            full, self.parameters, self._sensor, self.mount, self._real,
            extent=max(self._buckets.shape) * self._buckets.resolution, norm=self._tables.norm,
            gated=self._specialize and not known,
        )  # fmt: skip

    def _code(self, prepared: PreparedFeatures, known: bool, each: bool) -> frozenset[str]:
        with_range, with_bearing, with_signature = np.any(prepared.measured, axis=0) | (not self._specialize)
        return self._flags | flags_if(
            RANGE=with_range, BEARING=with_bearing, SIGNATURE=with_signature, FIELD=not full_circle(self.parameters),
            KNOWN=known, MARGINAL=not known and self.association == "sum", PER_BEAM=each,
        )  # fmt: skip

    def _after(self, placed: PlacedPoses, which: Buffer, log_p: Buffer, features: int) -> Program:
        """Return the launch that adds the landmarks in view without a feature."""
        if not self.negative:
            return ()
        p = self.parameters
        flags = self._flags | flags_if(FIELD=not full_circle(p))
        flags = with_lanes_flag(self._backend.info.lanes, "count_unseen", flags)
        return (launch(
            "count_unseen", flags, (placed.count,), landmark=self._tables.landmark, start=self._tables.start,
            pose_cell=placed.cell, pose=placed.pose, pose_low=placed.low, which=which, log_p=log_p,
            buckets=Buckets(*self._buckets.shape, self._buckets.resolution), particles=placed.count, features=features,
            view=SensorView(
                p.range_max, math.cos(self.mount[2]), math.sin(self.mount[2]),
                -2.0 if full_circle(p) else math.cos(p.field_of_view / 2),
                self.temperature * log_weight(1 - p.p_detect),
            ),
        ),)  # fmt: skip
