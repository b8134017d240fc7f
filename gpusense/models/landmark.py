"""The landmark model, *Probabilistic Robotics* section 6.6: features against a map of landmarks."""

from __future__ import annotations

import math
import threading

import numpy as np

from gpusense import _checks, arrays
from gpusense.backends import Backend, BackendInfo, get_backend
from gpusense.backends.base import Buffer
from gpusense.cloud import Cloud, Placed
from gpusense.features import (
    PreparedFeatures,
    check_correspondence,
    check_features,
    describe,
    full_circle,
    prepare_features,
    signature_mass,
)
from gpusense.frames import split
from gpusense.landmarks import LandmarkMap, make_buckets
from gpusense.lanes import widened
from gpusense.models.scan_model import chunk_of, in_chunks, real_dtype
from gpusense.models.terms import log_weight
from gpusense.parameters import LandmarkParameters
from gpusense.plan import Omission, Plan, share
from gpusense.reference.landmarks import ARCS
from gpusense.region import Region
from gpusense.workspace import Workspace

# Limits of the joint association: 2^features sets, and every landmark is tried with each of them.
JOINT_FEATURES = 8
JOINT_LANDMARKS = 1024
_INT = np.dtype(np.int32)
# Landmarks of a launch that cost what a reading of a scan does.
_PER_READING = 8


class LandmarkModel:
    """log p(f | x, m) of the features that a sensor finds, by the landmarks that they may be.

    Each feature adds ``log(z_detect p(f | j) + z_false p_uniform(f))``; what p(f | j) and p_uniform are stands in
    docs/landmarks.md. Which landmark j a feature is, is given, or chosen by ``association`` (tables 6.4 and 6.5).

    Args:
        landmarks: The map.
        parameters: Deviations, weights and limits of the sensor.
        backend: Where it runs; see ``gpusense.devices()``.
        precision: ``"float32"`` or ``"float64"``.
        association: What a feature without a known landmark is: ``"nearest"`` is the likeliest landmark of each
            by itself (the book's maximum likelihood); ``"sum"`` sums over all landmarks, each with the prior 1 / M;
            ``"joint"`` is the likeliest assignment in which no two features are the same landmark, for at most 8
            features and 1024 landmarks.
        negative: Whether landmarks in view that no feature is add ``log(1 - p_detect)`` each; not with ``"sum"``.
        mount: The sensor's pose (x, y, yaw) on the robot [m, m, rad].
        temperature: In (0, 1]: multiplies the sum over features. 1 is the book's plain product.
        specialize: False leaves nothing out: same numbers, slower.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent; the message names both.
    """

    def __init__(
        self,
        landmarks: LandmarkMap,
        parameters: LandmarkParameters | None = None,
        *,
        backend: str | Backend = "auto",
        precision: str = "float32",
        association: str = "nearest",
        negative: bool = False,
        mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
        temperature: float = 1.0,
        specialize: bool = True,
    ) -> None:
        if not isinstance(landmarks, LandmarkMap):
            raise TypeError(f"landmarks: must be a LandmarkMap, got {_checks.show(landmarks)}")
        self.landmarks = landmarks
        self.parameters = LandmarkParameters() if parameters is None else parameters
        if not isinstance(self.parameters, LandmarkParameters):
            raise TypeError(f"parameters: must be LandmarkParameters, got {_checks.show(parameters)}")
        p = self.parameters
        if p.sigma_signature is not None and landmarks.signatures is None:
            rule = "must be None for a map without signatures"
            raise ValueError(f"sigma_signature: {rule}, got {p.sigma_signature}")
        self.association = _checks.choice("association", association, ("nearest", "sum", "joint"))
        for name, value in (("negative", negative), ("specialize", specialize)):
            if not isinstance(value, bool):
                raise TypeError(f"{name}: must be True or False, got {_checks.show(value)}")
        if negative and self.association == "sum":
            raise ValueError("association: must be 'nearest' or 'joint' with negative=True, got 'sum'")
        if self.association == "joint" and len(landmarks) > JOINT_LANDMARKS:
            rule = f"must be at most {JOINT_LANDMARKS} with association='joint'"
            raise ValueError(f"landmarks: {rule}, got {len(landmarks)}")
        self.negative = negative
        x, y, yaw = (float(value) for value in _checks.array("mount", mount, (3,)))
        self.mount = (x, y, yaw)
        self.temperature = _checks.real("temperature", temperature, above=0, high=1)
        self._specialize = specialize
        self._backend = get_backend(backend)
        self._real = real_dtype(precision, self._backend)
        self._workspace = Workspace(self._backend)
        # Threads may share a model: its buffers serve one call at a time.
        self._lock = threading.Lock()
        self._sensor = describe(p, landmarks)
        tiny, most = np.finfo(self._real).tiny, np.finfo(self._real).max
        if any(scale and not tiny <= scale <= most for scale in self._sensor.scales):
            raise ValueError(f"parameters: deviations must fit {self._real.name}, got {p}")
        self._buckets = make_buckets(landmarks)
        self._tables = self._upload()
        self._last: tuple[frozenset[str], PreparedFeatures, int] | None = None

    @property
    def device(self) -> BackendInfo:
        """The device the model is compiled for."""
        return self._backend.info

    @property
    def precision(self) -> str:
        """``"float32"`` or ``"float64"``."""
        return self._real.name

    def log_likelihood(self, poses: object, features: object, correspondence: object = None) -> np.ndarray:
        """log p(f_1 ... f_F | x, m) for each particle, natural logarithm.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad].
            features: (F, 2) ranges [m] and bearings [rad], or (F, 3) with signatures; NaN is what was not measured.
            correspondence: None, or (F,) indices of the landmarks that the features are, -1 for a false positive.

        Returns:
            (N,) log-likelihoods in the model's precision: densities in 1/m, 1/rad and 1/unit of the signature for what
            was measured.

        Raises:
            TypeError: an argument does not hold numbers, or indices that are no integers.
            ValueError: a wrong shape, a pose that is not finite, a feature outside what the sensor can measure, an
                index that is no landmark's, or more than 8 features for a joint association.
        """
        log_p, _, _ = self._score(poses, features, correspondence, each=False)
        return log_p

    def associate(self, poses: object, features: object) -> tuple[np.ndarray, np.ndarray]:
        """The landmark that each feature is, for each particle.

        With ``association="sum"`` it is the landmark with the largest part of the sum.

        Args:
            poses: (N, 3) robot poses in the world [m, m, rad].
            features: (F, 2) or (F, 3), as in ``log_likelihood``.

        Returns:
            (N, F) int32 indices in the map, -1 where a false positive is likelier, and (N, F) what each feature adds to
            the log-likelihood before the temperature.

        Raises:
            TypeError, ValueError: as ``log_likelihood``.
        """
        _, which, parts = self._score(poses, features, None, each=True)
        return which, parts

    def explain(self) -> str:
        """What this scene does not need, why, and what leaving it out saves; features as of the last call."""
        p, count = self.parameters, len(self.landmarks)
        title = f"landmark model, {self.association}, {self.precision}, {self.device.selection} ({self.device.name})"
        code = frozenset() if self._last is None else self._last[0]
        if not self._specialize:
            return str(Plan(f"{title}, specialize=False", code, ()))
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
        if not self.negative:
            omissions.append(Omission("negative information", "negative=False", "a look at all landmarks in view"))
        if self._last is not None:
            omissions += self._last_omissions(*self._last, count)
        return str(Plan(title, code, tuple(omissions)))

    def _last_omissions(
        self, code: frozenset[str], prepared: PreparedFeatures, given: int, count: int
    ) -> list[Omission]:
        found, silent = [], given - len(prepared.columns)
        if silent:
            why = f"{silent} of {given} features do not depend on the pose"
            found.append(Omission("features", why, f"{share(silent, given)} of the features"))
        if "KNOWN" in code:
            found.append(Omission("search", "correspondences are known", f"{count - 1} of {count} landmarks"))
        elif len(prepared.columns) and np.isfinite(prepared.radius).any():
            looked = self._looked_at(prepared)
            why = f"beyond {prepared.radius.max():.3g} m of where features point densities are below eps of the rest"
            found.append(Omission("far landmarks", why, f"about {share(count - looked, count)} of {count} landmarks"))
        return found

    def _looked_at(self, prepared: PreparedFeatures) -> float:
        """Landmarks that a feature looks at, on average over a map that is evenly filled."""
        count, side = len(self.landmarks), self._buckets.resolution
        across = np.maximum(2 * prepared.radius, 0) + side
        rows, cols = self._buckets.shape
        looked = np.minimum(across, rows * side) * np.minimum(across, cols * side) / (rows * cols * side**2)
        return float(count * np.minimum(looked, 1).mean()) if len(looked) else 0.0

    def _upload(self) -> dict[str, Buffer]:
        """The map's tables on the device."""
        b, p, real = self._buckets, self.parameters, self._real
        signature = np.zeros((len(self.landmarks), 4))
        if self.landmarks.signatures is not None:
            own = self.landmarks.signatures[b.index]
            high, low = split(own, real)
            with np.errstate(divide="ignore"):
                norm = -np.log(signature_mass(p, self.landmarks)[b.index])
            signature[:, 0], signature[:, 1], signature[:, 2] = high, low, norm
        self._norm = float(signature[:, 2].max(initial=0.0))
        high, low = split(np.array([p.range_max, p.field_of_view]), real)
        # The density of a bearing at zero range, over the largest one there is elsewhere, but for the scale.
        scale = self._sensor.scales[1]
        flat = p.field_of_view / math.sqrt(math.pi)
        flat /= math.erf(math.pi * scale) if full_circle(p) and scale else 1.0
        terms = np.array([high[0], low[0], high[1], flat], real)
        arcs = np.empty((len(ARCS), 2), real)
        given = np.array(ARCS)
        arcs[:, 0] = given[:, 0]
        arcs[:, 1] = (given[:, 0] - arcs[:, 0]) + given[:, 1]
        own_tables = {
            "landmark": b.table(real), "signature": signature.astype(real), "start": b.start, "terms": terms,
            "arcs": arcs, "nobody": np.zeros(1, _INT),
        }  # fmt: skip
        return {name: self._backend.upload(np.ascontiguousarray(table)) for name, table in own_tables.items()}

    def _flags(self, prepared: PreparedFeatures, known: bool, each: bool) -> frozenset[str]:
        flags = {"FLOAT64"} if self._real == np.float64 else set()
        names = ("RANGE", "BEARING", "SIGNATURE")
        there = np.asarray(prepared.measured.any(axis=0))
        flags |= {name for name, used in zip(names, there.tolist(), strict=True) if used or not self._specialize}
        flags |= {"FIELD"} if not full_circle(self.parameters) else set()
        flags |= {"KNOWN"} if known else {"MARGINAL"} if self.association == "sum" else set()
        return frozenset(flags | ({"PER_BEAM"} if each else set()))

    def _score(
        self, poses: object, features: object, correspondence: object, *, each: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """log p of each particle, and with ``each`` the (N, F) landmarks and what features add."""
        p, backend = self.parameters, self._backend
        cloud = Cloud(arrays.copied_to_host(poses, backend, "poses"), backend)
        given = check_features(arrays.copied_to_host(features, backend, "features"), p, self._sensor.span)
        known = correspondence is not None
        partner = np.full(len(given), -1, np.int64)
        if known:
            partner = check_correspondence(correspondence, len(given), len(self.landmarks))
        extent = max(self._buckets.shape) * self._buckets.resolution
        prepared = prepare_features(
            given, p, self._sensor, self.mount, self._real,
            extent=extent, norm=self._norm, gated=self._specialize and not known,
        )  # fmt: skip
        fixed = 0.0
        if known:
            # False positives are the same at every pose.
            mine = partner[prepared.columns] >= 0
            fixed = float(prepared.false[prepared.columns[~mine]].sum())
            prepared = PreparedFeatures(
                prepared.columns[mine], prepared.numbers[mine], prepared.measured[mine], prepared.false
            )
        elif self.association == "joint" and len(prepared.columns) > JOINT_FEATURES:
            rule = f"must be at most {JOINT_FEATURES} with association='joint'"
            raise ValueError(f"features: {rule}, got {len(prepared.columns)}")
        log_p = np.empty(cloud.count, self._real)
        which = np.full((cloud.count, len(given) if each else 0), -1, _INT)
        parts = np.zeros((cloud.count, len(given) if each else 0), self._real)
        with self._lock:
            flags = self._flags(prepared, known, each or self.negative)
            self._run(cloud, prepared, partner, fixed, flags, (log_p, which, parts), each)
            self._workspace.wait()
        return log_p, which, parts

    def _run(
        self,
        cloud: Cloud,
        prepared: PreparedFeatures,
        partner: np.ndarray,
        fixed: float,
        flags: frozenset[str],
        out: tuple[np.ndarray, np.ndarray, np.ndarray],
        each: bool,
    ) -> None:
        """Score all particles in pieces that fit the device."""
        space, backend, real = self._workspace, self._backend, self._real
        log_p, which, parts = out
        count, known = len(prepared.columns), "KNOWN" in flags
        feature = space.upload("feature", np.resize(prepared.numbers, (max(count, 1), prepared.numbers.shape[1])))
        places = self._buckets.place_of[partner[prepared.columns]] if known else np.zeros(0, _INT)
        partners = space.upload("partner", np.append(places, np.int32(0)).astype(_INT))
        joint = not known and self.association == "joint"
        looked = 1.0 if known else len(self.landmarks) if joint else self._looked_at(prepared)
        work, kept = max(count, 1) * (1 + looked / _PER_READING), 0.0
        if joint:
            work, kept = work * (1 << count), (1 << count) * (1 + 2.0 * count)
        elif "PER_BEAM" in flags:
            kept = 2.0 * count
        work = min(work, 1e9)
        chunk = chunk_of(backend, math.ceil(work), real.itemsize * kept / work)
        self._last = (flags, prepared, len(partner))

        def run(begin: int, end: int) -> None:
            frame = (Region(0, 0, *self._buckets.shape), self._buckets, self.mount)
            given = cloud.given(backend, space, (begin, end))
            placed = cloud.place(backend, space, given, (begin, end), frame, real, careful=True)
            size = (end - begin) * count
            result = space.empty("log_p", end - begin, real)
            part = space.empty("parts", size if "PER_BEAM" in flags else 1, real)
            chosen = space.empty("which", size if "PER_BEAM" in flags else 1, _INT)
            outputs = (result, part, chosen)
            if joint:
                self._launch_joint(placed, feature, flags, outputs, (end - begin, count), fixed)
            else:
                self._launch(placed, feature, partners, flags, outputs, (end - begin, count), fixed)
            if self.negative:
                self._launch_unseen(placed, chosen, result, (end - begin, count))
            space.download(result, log_p[begin:end])
            if each and count:
                found = backend.download(chosen, np.empty((end - begin, count), _INT))
                which[begin:end, prepared.columns] = np.where(
                    found >= 0, self._buckets.index[found] if len(self.landmarks) else -1, -1
                )
                parts[begin:end, prepared.columns] = backend.download(part, np.empty((end - begin, count), real))

        in_chunks(cloud.count, chunk, space, run)

    def _launch(
        self,
        placed: Placed,
        feature: Buffer,
        partners: Buffer,
        flags: frozenset[str],
        outputs: tuple[Buffer, Buffer, Buffer],
        counts: tuple[int, int],
        fixed: float,
    ) -> None:
        t, b, landmarks = self._tables, self._buckets, len(self.landmarks)
        prior = -math.log(landmarks) if "MARGINAL" in flags and landmarks else 0.0
        flags = widened(self._backend.info, "score_features", flags)
        self._backend.compile("score_features", flags)(
            (counts[0],), t["landmark"], t["signature"], t["start"], placed.cell, placed.pose, placed.low, feature,
            partners, t["terms"], t["arcs"], *outputs, *b.shape, landmarks, *counts, b.resolution, prior, fixed,
            self.temperature,
        )  # fmt: skip

    def _launch_joint(
        self,
        placed: Placed,
        feature: Buffer,
        flags: frozenset[str],
        outputs: tuple[Buffer, Buffer, Buffer],
        counts: tuple[int, int],
        fixed: float,
    ) -> None:
        t, b, space = self._tables, self._buckets, self._workspace
        sets = 1 << counts[1]
        scratch = (
            space.empty("best", counts[0] * sets, self._real),
            space.empty("choice", counts[0] * sets * counts[1], _INT),
            space.empty("value", counts[0] * sets * counts[1], self._real),
        )
        self._backend.compile("joint_features", flags)(
            (counts[0],), t["landmark"], t["signature"], placed.cell, placed.pose, placed.low, feature, t["terms"],
            t["arcs"], *scratch, *outputs, len(self.landmarks), *counts, sets, b.resolution, fixed, self.temperature,
        )  # fmt: skip

    def _launch_unseen(self, placed: Placed, chosen: Buffer, result: Buffer, counts: tuple[int, int]) -> None:
        p, t, b = self.parameters, self._tables, self._buckets
        least = -2.0 if full_circle(p) else math.cos(p.field_of_view / 2)
        log_missed = self.temperature * log_weight(1 - p.p_detect)
        flags = frozenset({"FLOAT64"} if self._real == np.float64 else ())
        self._backend.compile("count_unseen", flags)(
            (counts[0],), t["landmark"], t["start"], placed.cell, placed.pose, placed.low, chosen, result, *b.shape,
            *counts, b.resolution, p.range_max, math.cos(self.mount[2]), math.sin(self.mount[2]), least, log_missed,
        )  # fmt: skip
