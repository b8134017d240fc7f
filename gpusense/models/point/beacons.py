"""Ranges to known beacons, as of ultra-wideband radios."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Precision
from gpusense.backends import Selection, arrays
from gpusense.interface.constants import BEACON, FARTHEST, NORMAL, STUDENT_T, TWO_NORMALS
from gpusense.interface.flags import flags_if
from gpusense.interface.plan import Omission
from gpusense.interface.structs import BeaconTerms, packed
from gpusense.models.point.base import (
    DIGITS,
    PI,
    PointModel,
    counted_omissions,
    log_of,
    normal_terms,
    rand_omissions,
    relative_omissions,
    total,
    two_parts,
)
from gpusense.models.point.sampling import BEACONS, draws_at, mounted, normal_within, within
from gpusense.reference.error_free import two_sum
from gpusense.world.range_causes import RandomDensity
from gpusense.world.sensor_parameters import BeaconParameters


class BeaconModel(PointModel):
    """log p(z_1 ... z_F | x) of ranges to known beacons.

    Each range adds ``log(z_hit f(z - d - bias) / m + z_rand / range_max)``. d is the antenna's distance to the beacon,
    f the density of the parameters' kind and m its mass on [0, range_max], so that each range's density integrates to
    1; where d + bias lies outside this interval, m is taken at the nearest end.

    Args:
        xy: (M, 2) positions of the beacons in the world [m].
        parameters: Density, bias, weights and the antenna's mount.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``; either keeps the digits of large coordinates.
        temperature: In (0, 1]: multiplies the sum over ranges. 1 is the plain product of densities.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs
        >>> model = gs.BeaconModel([(0.0, 0.0), (8.0, 0.0)], backend="numpy")
        >>> poses = [(4.0, 3.0, 0.0), (4.0, 0.0, 0.0)]
        >>> int(model.log_likelihood(poses, [5.0, 5.0]).argmax())
        0
    """

    def __init__(
        self,
        xy: ArrayLike,
        parameters: BeaconParameters | None = None,
        *,
        backend: Selection = "auto",
        precision: Precision = "float32",
        temperature: float = 1.0,
    ) -> None:
        self.parameters = checks.or_default("parameters", parameters, BeaconParameters)
        points = checks.as_array("xy", xy)
        # An empty list has no columns.
        self.xy = checks.array("xy", points.reshape(0, 2) if points.shape == (0,) else points, ("M", 2)).copy()
        self.xy.flags.writeable = False
        super().__init__(backend, precision, temperature)
        bias = self.parameters.bias
        if isinstance(bias, tuple) and len(bias) != len(self.xy):
            raise ValueError(f"parameters: bias must be one for each of {len(self.xy)} beacons, got {len(bias)}")
        self._bias = np.broadcast_to(np.array(bias, np.float64), (len(self.xy),))
        self._flags |= flags_if(RAND=self.parameters.z_rand > 0)
        # Poses and beacons are placed relative to the middle of the beacons.
        middle = (self.xy.min(axis=0) / 2 + self.xy.max(axis=0) / 2) if len(self.xy) else np.zeros(2)
        self._origin = float(middle[0]), float(middle[1])
        far = np.abs(self.xy - middle).max(initial=0.0)
        if not far <= FARTHEST:
            raise ValueError(f"xy: must be within {FARTHEST:.2g} m of the middle, got {far:.2g} m")
        self._kind, terms, series = self._mixture()
        self._count = len(series)
        self._terms_buffer = self._backend.upload(packed([terms], self._real))
        self._series_buffer = self._backend.upload(series)

    def log_likelihood(
        self, poses: AnyArray, ranges: ArrayLike, ids: ArrayLike | None = None, *, out: Any = None
    ) -> np.ndarray:
        """Return log p(z_1 ... z_F | x) for each particle, natural logarithm.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array of any library, like scans.
            ranges: (F,) ranges [m] to all M beacons, or to the beacons in ``ids``. NaN, and values outside [0,
                range_max], are missing and add 0.
            ids: None, or (F,) indices of the beacons that the ranges belong to; one may have several.
            out: The array for the result, in the memory of the poses.

        Returns:
            (N,) log-likelihoods in the model's precision, densities in 1/m for each range; 0 without ranges.

        Raises:
            TypeError: An argument does not hold real numbers, or indices that are no integers.
            ValueError: A wrong shape, a pose that is not finite, an index that is no beacon's.
        """
        beacon, left_out = self._prepare(ranges, ids)
        count = len(beacon)
        if count == 0:
            return self._score(poses, out, None, left_out)
        program = self._programmer(
            "place_relative", (*self._origin, *self.parameters.mount), "score_beacons", self._flags,
            dict(beacon=beacon), terms=self._terms_buffer, series=self._series_buffer, beacons=count,
            count=self._count, kind=self._kind,
        )  # fmt: skip
        return self._score(poses, out, program, left_out, items=count)

    def _arguments(self) -> dict[str, Any]:
        return super()._arguments() | {"xy": self.xy}

    def sample(self, poses: AnyArray, seed: int = 0, *, step: int = 0, ids: ArrayLike | None = None) -> np.ndarray:
        """Draw ranges from p(z | x) at each pose, on the host in float64; see ``BeamModel.sample``.

        Args:
            poses: (N, 3) or (S, N, 3) robot poses in the world [m, m, rad].
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, 0 to 2^31 - 1; each step has different random numbers.
            ids: None for all M beacons, or (F,) indices of the beacons; one may have several ranges.

        Returns:
            (N, F) or (S, N, F) ranges in [0, range_max] [m], a NumPy array of float64. NaN where distance and bias lie
            beyond range_max, or below 0, and the range is not observed.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, a seed or step beyond its limits, or an index that is
                no beacon's.

        Example:
            >>> import gpusense as gs
            >>> model = gs.BeaconModel([(0.0, 0.0), (8.0, 0.0)], backend="numpy")
            >>> model.sample([(4.0, 3.0, 0.0)] * 5, seed=1).shape
            (5, 2)
        """
        p, index = self.parameters, self._indices(ids)
        draws = draws_at(poses, self._backend, seed, step)
        antenna = mounted(draws.poses, p.mount)
        ranges = np.empty((len(antenna), len(index)))
        for f, j in enumerate(index.tolist()):
            (kind, u), (heavy, _) = draws.uniform(BEACONS + f), draws.uniform(BEACONS + f, 1)
            mean = np.hypot(*(antenna - self.xy[j]).T) + self._bias[j]
            hit = self._hits(u, heavy, mean)
            ranges[:, f] = np.where(kind * (p.z_hit + p.z_rand) < p.z_hit, hit, RandomDensity(p.range_max).drawn(u))
        return draws.reshaped(ranges)

    def _hits(self, u: np.ndarray, heavy: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return correct ranges around means."""
        p = self.parameters
        if p.kind == "student_t":
            from scipy.special import stdtr, stdtrit

            nu = float(p.nu)
            return within(u, mean, p.sigma_range, 0.0, p.range_max, lambda x: stdtr(nu, x), lambda q: stdtrit(nu, q))
        hit = normal_within(u, mean, p.sigma_range, 0.0, p.range_max)
        if p.kind == "mixture":
            wide = normal_within(u, mean, p.sigma_heavy, 0.0, p.range_max)
            hit = np.where(heavy < p.heavy_weight, wide, hit)
        return hit

    def _indices(self, ids: object) -> np.ndarray:
        """Return the (F,) indices of beacons."""
        if ids is None:
            return np.arange(len(self.xy))
        chosen = checks.as_array("ids", ids)
        return checks.indices("ids", chosen if chosen.size else chosen.astype(np.int64), len(self.xy), ("F",))

    def _options(self) -> tuple[str, ...]:
        return f"beacons={len(self.xy)}", f"kind={self.parameters.kind!r}"

    def _describe(self) -> tuple[str, list[Omission]]:
        p = self.parameters
        omissions = rand_omissions(p.z_rand, per="particle and range")
        return f"ranges to beacons, {p.kind}", omissions + relative_omissions(p.mount, self.precision)

    def _prepare(self, ranges: object, ids: object) -> tuple[np.ndarray, list[Omission]]:
        """Return the (F, BEACON) numbers of the valid ranges, and the omissions of the invalid ranges."""
        p = self.parameters
        on_host = arrays.copied_to_host(ranges, self._backend, "ranges")
        index = self._indices(ids)
        z = checks.array("ranges", on_host, (len(index),), finite=False)
        missing, valid = np.isnan(z), (z >= 0) & (z <= p.range_max)
        left_out: list[Omission] = []
        for what, which, why in (
            ("missing ranges", missing, "are nan"),
            ("impossible ranges", ~(missing | valid), f"are not in [0, {p.range_max:g}] m"),
        ):
            left_out += counted_omissions(what, int(np.count_nonzero(which)), len(z), why, "the ranges")
        used = index[valid]
        bias, rows = self._bias[used], np.empty((len(used), BEACON), self._real)
        origin = np.column_stack([np.tile(self._origin, (len(used), 1)), bias])
        numbers, rest = two_sum(np.column_stack([self.xy[used], z[valid]]), -origin)
        rows[:, :-1:2], rows[:, -1] = numbers, bias
        rows[:, 1::2] = (numbers - rows[:, :-1:2]) + rest
        return rows, left_out

    def _mixture(self) -> tuple[int, BeaconTerms, np.ndarray]:
        """Return the kind of density, and the numbers and the series of the kernel file ``beacons``."""
        p, real = self.parameters, self._real
        self._check_scale("sigma_range", p.sigma_range)
        self._check_scale("range_max", p.range_max)
        self._check_scale("bias", max(float(np.abs(self._bias).max(initial=0.0)), 1.0), "its size ")
        random = RandomDensity(p.range_max).log_peak(p.z_rand)
        rest: dict[str, Any] = {}
        series = np.zeros(1)
        with localcontext(prec=DIGITS):
            if p.kind == "student_t":
                kind, nu = STUDENT_T, Decimal(p.nu)
                log_peak = _log_t_peak(p.nu) - Decimal(p.sigma_range).ln()
                k = (2 * log_peak / (nu + 1)).exp()
                first = two_parts((1 / (Decimal(p.sigma_range) * (nu * k).sqrt()), log_of(p.z_hit)), real)
                rest = dict(zip(("offset", "offset_low"), two_parts((1 / k,), real), strict=True))
                arc, series = t_series(p.nu)
                flat = 1 / (p.sigma_range * math.sqrt(p.nu))
                rest |= dict(power=(p.nu + 1) / 2, t_scale=flat, arc=arc, odd=float(p.nu % 2))
            else:
                kind, share = NORMAL, 1.0
                if p.kind == "mixture":
                    self._check_scale("sigma_heavy", p.sigma_heavy)
                    kind, share = TWO_NORMALS, 1 - p.heavy_weight
                    heavy = normal_terms(p.sigma_heavy, total(log_of(p.z_hit), log_of(p.heavy_weight)))
                    names = ("wide_scale", "wide_scale_low", "wide_peak", "wide_peak_low")
                    rest = dict(zip(names, two_parts(heavy, real), strict=True))
                first = two_parts(normal_terms(p.sigma_range, total(log_of(p.z_hit), log_of(share))), real)
        return kind, BeaconTerms(random, p.range_max, *first, **rest), series.astype(real)


def _log_t_peak(nu: int) -> Decimal:
    """Return the log peak of a Student t density of scale 1, by a recurrence for its ratio of gamma functions."""
    ratio = 1 / PI.sqrt() if nu % 2 else PI.sqrt() / 2
    for n in range(2 - nu % 2, nu, 2):
        ratio = ratio * (n + 1) / n
    return (ratio / (nu * PI).sqrt()).ln()


def t_series(nu: int) -> tuple[float, np.ndarray]:
    """Return the factor of the arc, and the series in its cosine's square, of a Student t's mass between -t and t.

    Source: Abramowitz and Stegun, 26.7.3 (odd nu) and 26.7.4 (even nu).
    """
    odd = nu % 2
    factors = [(n - 1 + odd) / (n + odd) for n in range(2, nu - odd, 2)]
    if nu == 1:
        return 2 / math.pi, np.zeros(1)
    series = np.cumprod([1.0, *factors])
    return (2 / math.pi, 2 / math.pi * series) if odd else (0.0, series)
