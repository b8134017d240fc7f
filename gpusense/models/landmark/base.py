"""Base of the models that compare features with a map of landmarks or lines: association, and launches of a call."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Association
from gpusense.backends import Selection, arrays
from gpusense.backends.base import Buffer
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Launch, Program, launch
from gpusense.interface.plan import Omission, share
from gpusense.interface.structs import Buckets as BucketSizes
from gpusense.interface.structs import Score
from gpusense.models.landmark.features import (
    LandmarkTables,
    PreparedFeatures,
    check_correspondence,
    full_circle,
    look_at_feature_angles,
)
from gpusense.models.point.base import PointModel, counted_omissions, float64_omissions
from gpusense.models.poses import Part, PlacedPoses, Poses, place
from gpusense.world.frames import Mount
from gpusense.world.landmarks import Buckets
from gpusense.world.parameters import LandmarkParameters
from gpusense.world.windows import Frame, Window

# Limits of the joint association, which tries every landmark with each of 2^features sets.
JOINT_FEATURES = 8
JOINT_LANDMARKS = 1024
_INT = np.dtype(np.int32)
# Landmarks of a launch that cost as much as one reading of a scan.
_PER_READING = 8


@dataclass(frozen=True)
class Call:
    """Values that all particles of a call share."""

    prepared: PreparedFeatures  # the evaluated features
    places: np.ndarray  # places of the landmarks of known features among the buckets
    fixed: float  # the constant term: log-likelihoods of known false positives
    flags: frozenset[str]  # flags of the scoring kernel
    joint: bool  # true if the features are assigned jointly

    @property
    def count(self) -> int:
        """Number of evaluated features."""
        return len(self.prepared.columns)


class FeatureModel(PointModel):
    """Base of the models of features: each belongs to a landmark or line of the map, or is a false positive.

    Subclasses make ``_buckets`` and ``_tables`` of their map.
    """

    parameters: Any
    # The column of features with angles, and their name.
    _angles: ClassVar[tuple[int, str]]
    _buckets: Buckets
    _tables: LandmarkTables
    # Whether launches after the score need the landmark of each feature.
    _negative = False

    def __init__(
        self, name: str, count: int, backend: Selection, precision: str, *, association: Association,
        mount: tuple[float, float, float], temperature: float, specialize: bool,
    ) -> None:  # fmt: skip
        self.association = checks.choice("association", association, ("nearest", "sum", "joint"))
        self._specialize = checks.boolean("specialize", specialize)
        if self.association == "joint" and count > JOINT_LANDMARKS:
            raise ValueError(f"{name}: must be at most {JOINT_LANDMARKS} with association='joint', got {count}")
        x, y, yaw = (float(value) for value in checks.array("mount", mount, (3,)))
        self.mount = (x, y, yaw)
        self._name, self._count, self._seen = name, count, False
        super().__init__(backend, precision, temperature)

    def _arguments(self) -> dict[str, Any]:
        names = (self._name, "association", "mount")
        options = {name: getattr(self, name) for name in names} | {"specialize": self._specialize}
        return super()._arguments() | options

    def _options(self) -> tuple[str, ...]:
        return f"{self._name}={self._count}", f"association={self.association!r}"

    @property
    @abstractmethod
    def corners(self) -> np.ndarray:
        """(P, 2) points in the world; their bounding box contains the map [m]."""

    @abstractmethod
    def log_likelihood(
        self, poses: AnyArray, features: ArrayLike, correspondence: ArrayLike | None = None, *, out: Any = None
    ) -> np.ndarray:
        """Return log p of features for each particle, natural logarithm."""

    def associate(self, poses: AnyArray, features: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the landmark or line of each feature, for each particle.

        ``association="sum"`` gives the landmark or line with the largest part of the sum.

        ``poses``: (N, 3) robot poses in the world [m, m, rad], as in ``log_likelihood``; ``features``: as in
        ``log_likelihood``.

        Returns:
            (N, F) int32 indices in the map, -1 where a false positive is likelier or a feature is left out, and (N, F)
            terms of the features in the log-likelihood, before the temperature; always NumPy arrays.
        """
        _, which, parts = self._evaluate(poses, features, None, each=True)
        return which, parts

    def _partners(self, correspondence: ArrayLike | None) -> np.ndarray:
        """Return the indices of the landmarks that are drawn: all, or all in a correspondence."""
        if correspondence is None:
            return np.arange(self._count)
        partners = checks.as_array("correspondence", correspondence)
        return check_correspondence(partners, partners.size, self._count)

    def _read(self, features: object) -> tuple[np.ndarray, np.ndarray]:
        """Return features as ``_possible`` does; the first calls also check for angles in degrees."""
        full, impossible = self._possible(features)
        if not self._seen:
            self._seen = look_at_feature_angles(features, *self._angles)
        return full, impossible

    @abstractmethod
    def _possible(self, features: object) -> tuple[np.ndarray, np.ndarray]:
        """Return features as float64 rows, all NaN where impossible, and (F,) whether they are impossible."""

    @abstractmethod
    def _numbers(self, full: np.ndarray, known: bool) -> PreparedFeatures:
        """Return the numbers of the kernels for features that were read."""

    @abstractmethod
    def _code(self, prepared: PreparedFeatures, known: bool, each: bool) -> frozenset[str]:
        """Return the flags of the kernels."""

    def _after(self, placed: PlacedPoses, which: Buffer, log_p: Buffer, features: int) -> Program:
        return ()

    def _prepare(self, full: np.ndarray, correspondence: object, each: bool) -> Call:
        """Return the values of possible features that all particles share."""
        known = correspondence is not None
        prepared = self._numbers(full, known)
        fixed, places = 0.0, np.zeros(0, _INT)
        joint = not known and self.association == "joint"
        if known:
            partner = check_correspondence(correspondence, len(full), self._count)[prepared.columns]
            real = partner >= 0
            fixed = float(prepared.false[prepared.columns[~real]].sum())
            prepared, places = prepared.chosen(real), self._buckets.place_of[partner[real]]
        elif joint and len(prepared.columns) > JOINT_FEATURES:
            got = len(prepared.columns)
            raise ValueError(f"features: must be at most {JOINT_FEATURES} with association='joint', got {got}")
        return Call(prepared, places, fixed, self._code(prepared, known, each or self._negative), joint)

    def _evaluate(
        self, poses: object, features: object, correspondence: object, *, each: bool = False, out: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return log p of each particle; with ``each`` also the (N, F) landmarks and terms of the features."""
        full, impossible = self._read(arrays.copied_to_host(features, self._backend, "features"))
        call = self._prepare(full, correspondence, each)
        known = correspondence is not None
        left_out = feature_omissions(
            call.prepared,
            self._buckets,
            name=self._name,
            total=len(full),
            impossible=int(impossible.sum()),
            known=known,
        )
        # Keyed by the first particle of a piece, since a piece that does not fit into memory is repeated in halves.
        empty = np.empty((0, len(full)))
        pieces = {-1: (empty.astype(_INT), empty.astype(self._real))}

        def after(part: Part) -> None:
            if each:
                pieces[part[0]] = self._download(call, part[1] - part[0], len(full))

        items, itemsize = self._cost(call, known)
        log_p = self._score(
            poses, out, functools.partial(self._program, call), left_out, items=items, itemsize=itemsize, after=after
        )
        which, added = zip(*(pieces[first] for first in sorted(pieces)), strict=True)
        return log_p, np.concatenate(which), np.concatenate(added)

    def _cost(self, call: Call, known: bool) -> tuple[int, float]:
        """Return the cost of a particle, in readings of a scan, and the bytes that it keeps for each."""
        looked = 1.0 if known else self._count if call.joint else looked_at(call.prepared, self._buckets)
        work, kept = max(call.count, 1) * (1 + looked / _PER_READING), 0.0
        if call.joint:
            work, kept = work * (1 << call.count), (1 << call.count) * (1 + 2.0 * call.count)
        elif "PER_BEAM" in call.flags:
            kept = 2.0 * call.count
        work = min(work, 1e9)
        return math.ceil(work), self._real.itemsize * kept / work

    def _program(self, call: Call, poses: Poses, part: Part, log_p: Buffer) -> Program:
        """Return the launches that score some poses into a buffer."""
        space, real, features, tables = self._workspace, self._real, call.count, self._tables
        frame = Frame(Window(0, 0, *self._buckets.shape), self._buckets, self.mount)
        placed = place(poses, part, frame, self._backend, space, real, careful=True)
        numbers, count = call.prepared.numbers, placed.count
        result = self._results(call, count)
        common = dict(
            landmark=tables.landmark, normal=tables.normal, signature=tables.signature, pose_cell=placed.cell,
            pose=placed.pose, pose_low=placed.low, terms=tables.terms, arcs=tables.arcs, log_p=log_p, **result,
            feature=space.upload("feature", np.resize(numbers, (max(features, 1), numbers.shape[1]))),
            landmarks=self._count, particles=count, features=features,
            buckets=BucketSizes(*self._buckets.shape, self._buckets.resolution),
            score=Score(call.fixed, self.temperature),
        )  # fmt: skip
        score = (self._joint_launch if call.joint else self._each_launch)(call, common)
        return (*placed.launches(), score, *self._after(placed, result["which"], log_p, features))

    def _results(self, call: Call, count: int) -> dict[str, Buffer]:
        """Return the buffers of the log-likelihoods of features, and of their landmarks."""
        size = count * call.count if "PER_BEAM" in call.flags else 1
        space = self._workspace
        return dict(parts=space.empty("parts", size, self._real), which=space.empty("which", size, _INT))

    def _download(self, call: Call, count: int, features: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, F) landmarks in the map and log-likelihoods; -1 and 0 for features that are not evaluated."""
        which, added = np.full((count, features), -1, _INT), np.zeros((count, features), self._real)
        if call.count:
            result = self._results(call, count)
            place = self._backend.download(result["which"], np.empty((count, call.count), _INT))
            index = self._buckets.index[place] if self._count else -1
            which[:, call.prepared.columns] = np.where(place >= 0, index, -1)
            parts = self._backend.download(result["parts"], np.empty((count, call.count), self._real))
            added[:, call.prepared.columns] = parts
        return which, added

    def _each_launch(self, call: Call, common: dict[str, Any]) -> Launch:
        """Return the launch in which each feature chooses its landmark, or sums over them, independently."""
        prior = -math.log(self._count) if "MARGINAL" in call.flags and self._count else 0.0
        partner = self._workspace.upload("partner", np.append(call.places, np.int32(0)).astype(_INT))
        flags = with_lanes_flag(self._backend.info.lanes, "score_features", call.flags)
        return launch(
            "score_features", flags, (common["particles"],), **common, start=self._tables.start, partner=partner,
            share=prior,
        )  # fmt: skip

    def _joint_launch(self, call: Call, common: dict[str, Any]) -> Launch:
        """Return the launch that finds the likeliest joint assignment."""
        space, sets, count = self._workspace, 1 << call.count, common["particles"]
        return launch(
            "joint_features", call.flags, (count,), **common, best=space.empty("best", count * sets, self._real),
            choice=space.empty("choice", count * sets * call.count, _INT),
            value=space.empty("value", count * sets * call.count, self._real), sets=sets,
        )  # fmt: skip


# ---- omissions of a landmark model: by its parameters, and by the features of a call


def looked_at(prepared: PreparedFeatures, buckets: Buckets) -> float:
    """Return the landmarks that a feature inspects, on average over an evenly filled map."""
    side, (rows, cols) = buckets.resolution, buckets.shape
    across = np.maximum(2 * prepared.radius, 0) + side
    looked = np.minimum(across, rows * side) * np.minimum(across, cols * side) / (rows * cols * side**2)
    return float(len(buckets.index) * np.minimum(looked, 1).mean()) if len(looked) else 0.0


def parameter_omissions(p: LandmarkParameters, negative: bool, mount: Mount, precision: str) -> list[Omission]:
    """Return the omissions of every call, by the parameters."""
    omissions = [
        Omission(name[6:], f"{name} = None", cost)
        for name, cost in (
            ("sigma_range", "1 exponent per particle, feature and landmark"),
            ("sigma_bearing", "1 arc tangent and 1 exponent per particle, feature and landmark"),
            ("sigma_signature", "1 exponent per particle, feature and landmark"),
        )
        if getattr(p, name) is None
    ]
    if full_circle(p):
        omissions.append(Omission("mass in the field of view", "it is a full circle", "2 erf or more per landmark"))
    if not negative:
        omissions.append(Omission("negative information", "negative=False", "a look at all landmarks in view"))
    return omissions + common_omissions(mount, precision)


def common_omissions(mount: Mount, precision: str) -> list[Omission]:
    """Return the omissions of every call, of landmarks and of lines."""
    omissions = []
    if mount[:2] == (0.0, 0.0):
        omissions.append(Omission("mount", "the sensor sits at the robot's origin", "a rotation per particle"))
    why = "positions, angles and exponents are kept in two numbers"
    return omissions + float64_omissions(precision, why, "wide units, which many devices lack")


def feature_omissions(
    prepared: PreparedFeatures, buckets: Buckets, *, name: str, total: int, impossible: int, known: bool
) -> list[Omission]:
    """Return the omissions by the features of a call; ``known``: whether the correspondences are known."""
    count, silent = len(buckets.index), total - len(prepared.columns) - impossible
    why = "features have a part that the sensor cannot measure"
    omissions = counted_omissions("impossible features", impossible, total, why, "them")
    omissions += counted_omissions("features", silent, total, "features do not depend on the pose", "them")
    if known:
        omissions.append(Omission("search", "correspondences are known", f"{count - 1} of {count} {name}"))
    elif len(prepared.columns) and np.isfinite(prepared.radius).any():
        spared = count - looked_at(prepared, buckets)
        if spared >= 0.5:
            why = f"beyond {prepared.radius.max():.3g} m of where features point densities are below eps of the rest"
            omissions.append(Omission(f"far {name}", why, f"about {share(spared, count)} of {count} {name}"))
    return omissions
