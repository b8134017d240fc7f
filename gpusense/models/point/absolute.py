"""Models of absolute sensors: position fixes and headings."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Precision
from gpusense.backends import Selection, arrays
from gpusense.interface.constants import NEARBY, NEGLIGIBLE, SERIES, VON_MISES, WAVES, WRAPS, log_weight
from gpusense.interface.flags import flags_if
from gpusense.interface.plan import Omission
from gpusense.interface.structs import HeadingTerms, PositionTerms, packed
from gpusense.models.point.base import (
    DIGITS,
    MISSING,
    PI,
    PointModel,
    log_of,
    normal_terms,
    rand_omissions,
    relative_omissions,
    total,
    two_parts,
)
from gpusense.models.point.sampling import HEADING, POSITION, draws_at, mounted, standard_normal, von_mises, wrapped
from gpusense.reference.relative import wrapped_difference
from gpusense.world.sensor_parameters import HeadingParameters, PositionParameters, check_covariance

# Up to this deviation a wrapped normal is a sum of normals, beyond it a Fourier series; either has few terms there.
_WIDEST_SUM = 1.5
# Rows of a covariance matrix.
_Matrix = tuple[tuple[Any, Any], tuple[Any, Any]]


class PositionModel(PointModel):
    """log p(z | x) of a position fix, as of a satellite receiver.

    The density is ``z_hit N(z; antenna, covariance) + z_rand / area`` within the region, and only the first part
    outside.

    Args:
        parameters: Covariance, weights, region and the antenna's mount.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``; either keeps the digits of large coordinates.
        temperature: In (0, 1]: multiplies log p, for errors that are not independent from fix to fix.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs
        >>> model = gs.PositionModel(gs.PositionParameters(sigma=2.0), backend="numpy")
        >>> int(model.log_likelihood([(0.0, 0.0, 0.0), (9.0, 4.0, 0.0)], (10.0, 5.0)).argmax())
        1
    """

    def __init__(
        self,
        parameters: PositionParameters,
        *,
        backend: Selection = "auto",
        precision: Precision = "float32",
        temperature: float = 1.0,
    ) -> None:
        checks.instance("parameters", parameters, PositionParameters)
        super().__init__(backend, precision, temperature)
        self.parameters = parameters
        self._hit: list[np.floating] = []
        if parameters.sigma is not None:
            square = Decimal(parameters.sigma) ** 2
            self._hit = self._gaussian("sigma", ((square, 0), (0, square)))
        elif parameters.covariance is not None:
            self._hit = self._gaussian("covariance", parameters.covariance)

    def log_likelihood(
        self, poses: AnyArray, fix: ArrayLike, covariance: ArrayLike | None = None, *, out: Any = None
    ) -> np.ndarray:
        """Return log p(z | x) of a fix for each particle, natural logarithm.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array of any library, like scans.
            fix: (2,) measured x and y of the antenna [m]. A value that is not finite is missing and has log p = 0.
            covariance: None, or the (2, 2) covariance matrix of this fix in the world [m^2].
            out: The array for the result, in the memory of the poses.

        Returns:
            (N,) log-likelihoods in the model's precision, densities in 1/m^2.

        Raises:
            TypeError: An argument does not hold real numbers.
            ValueError: A wrong shape, a pose that is not finite, or no covariance.
        """
        on_host = arrays.copied_to_host(fix, self._backend, "fix")
        x, y = (float(value) for value in checks.array("fix", on_host, (2,), finite=False))
        matrix = self._covariance(covariance)
        hit = self._hit if covariance is None else self._gaussian("covariance", matrix)
        if not (math.isfinite(x) and math.isfinite(y)):
            return self._score(poses, out, None, [MISSING])
        terms = self._terms(hit, x, y)
        possible = math.isfinite(terms.random)
        left_out = rand_omissions(possible, "the fix is outside the region") if self.parameters.z_rand else []
        program = self._programmer(
            "place_relative", (x, y, *self.parameters.mount), "score_position",
            self._flags | flags_if(RAND=possible), dict(terms=packed([terms], self._real)),
        )  # fmt: skip
        return self._score(poses, out, program, left_out)

    def sample(
        self, poses: AnyArray, seed: int = 0, *, step: int = 0, covariance: ArrayLike | None = None
    ) -> np.ndarray:
        """Draw a fix from p(z | x) at each pose, on the host in float64; see ``BeamModel.sample``.

        Args:
            poses: (N, 3) or (S, N, 3) robot poses in the world [m, m, rad].
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, 0 to 2^31 - 1; each step has different random numbers.
            covariance: None, or the (2, 2) covariance matrix of the fixes in the world [m^2].

        Returns:
            (N, 2) or (S, N, 2) x and y of the antenna [m], a NumPy array of float64.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, a seed or step beyond its limits, or no covariance.

        Example:
            >>> import gpusense as gs
            >>> model = gs.PositionModel(gs.PositionParameters(sigma=0.5), backend="numpy")
            >>> model.sample([(1.0, 2.0, 0.0)] * 3, seed=1).shape
            (3, 2)
        """
        p, matrix = self.parameters, self._covariance(covariance)
        draws = draws_at(poses, self._backend, seed, step)
        (kind, one), (other, _) = draws.uniform(POSITION), draws.uniform(POSITION, 1)
        first, second = standard_normal(one), standard_normal(other)
        # The factor of Cholesky.
        xx = math.sqrt(matrix[0][0])
        xy = matrix[0][1] / xx
        yy = math.sqrt(max(matrix[1][1] - xy * xy, 0.0))
        fix = mounted(draws.poses, p.mount) + np.stack([xx * first, xy * first + yy * second], axis=1)
        if p.z_rand > 0 and p.region is not None:
            x, y, far_x, far_y = p.region
            random = np.stack([x + one * (far_x - x), y + other * (far_y - y)], axis=1)
            fix = np.where((kind * (p.z_hit + p.z_rand) < p.z_hit)[:, None], fix, random)
        return draws.reshaped(fix)

    def _describe(self) -> tuple[str, list[Omission]]:
        p = self.parameters
        return "position fix", rand_omissions(p.z_rand) + relative_omissions(p.mount, self.precision)

    def _covariance(self, covariance: ArrayLike | None) -> _Matrix:
        """Return the covariance matrix of a fix, from the call or the parameters."""
        p = self.parameters
        if covariance is not None:
            return check_covariance("covariance", covariance)
        if p.sigma is not None:
            return (p.sigma**2, 0.0), (0.0, p.sigma**2)
        if p.covariance is None:
            raise ValueError("covariance: must be given where the parameters have none, got None")
        return p.covariance

    def _terms(self, hit: list[np.floating], x: float, y: float) -> PositionTerms:
        region, random = self.parameters.region, -math.inf
        if region is not None and region[0] <= x <= region[2] and region[1] <= y <= region[3]:
            random = log_weight(self.parameters.z_rand)
            random -= math.log(region[2] - region[0]) + math.log(region[3] - region[1])
        return PositionTerms(random, *hit)

    def _gaussian(self, name: str, covariance: _Matrix) -> list[np.floating]:
        """Return the whitening by the Cholesky factor, and the log of weight and peak, each as two numbers."""
        with localcontext(prec=DIGITS):
            (xx, xy), (_, yy) = (map(Decimal, row) for row in covariance)
            first = xx.sqrt()
            below = xy / first
            second = (yy - below * below).sqrt()
            for value in (first, second):
                self._check_scale(name, float(value), "" if name == "sigma" else "standard deviations ")
            root = Decimal(2).sqrt()
            a, c = 1 / (root * first), 1 / (root * second)
            b = -below / first * c
            peak = total(log_of(self.parameters.z_hit), -(2 * PI * first * second).ln())
        return two_parts((a, b, c, peak), self._real)


class HeadingModel(PointModel):
    """log p(z | x) of a heading, as of a compass.

    The density is ``z_hit p_hit(z - theta - offset) + z_rand / (2 pi)``; p_hit is a wrapped normal or von Mises
    density.

    Args:
        parameters: Kind, deviation or concentration, weights and offset.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``; either keeps the digits of headings of many turns.
        temperature: In (0, 1]: multiplies log p, for errors that are not independent from reading to reading.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs, math
        >>> model = gs.HeadingModel(gs.HeadingParameters(sigma=0.1), backend="numpy")
        >>> int(model.log_likelihood([(0.0, 0.0, 1.0), (0.0, 0.0, 0.0)], 2 * math.pi).argmax())
        1
    """

    def __init__(
        self,
        parameters: HeadingParameters | None = None,
        *,
        backend: Selection = "auto",
        precision: Precision = "float32",
        temperature: float = 1.0,
    ) -> None:
        self.parameters = checks.or_default("parameters", parameters, HeadingParameters)
        super().__init__(backend, precision, temperature)
        self._kind, terms, waves = self._mixture()
        self._flags |= flags_if(RAND=self.parameters.z_rand > 0)
        self._terms_buffer = self._backend.upload(packed([terms], self._real))
        self._waves_buffer = self._backend.upload(np.array(waves, self._real))

    def log_likelihood(self, poses: AnyArray, heading: float, *, out: Any = None) -> np.ndarray:
        """Return log p(z | x) of a heading for each particle, natural logarithm.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array of any library, like scans.
            heading: The reading [rad], any number of turns. A value that is not finite is missing and has log p = 0.
            out: The array for the result, in the memory of the poses.

        Returns:
            (N,) log-likelihoods in the model's precision, densities in 1/rad.

        Raises:
            TypeError: An argument does not hold real numbers.
            ValueError: A wrong shape, or a pose that is not finite.
        """
        on_host = arrays.copied_to_host(heading, self._backend, "heading")
        reading = float(checks.array("heading", on_host, (), finite=False))
        if not math.isfinite(reading):
            return self._score(poses, out, None, [MISSING])
        zero = np.zeros(1)
        turned = wrapped_difference(np.array([self.parameters.offset]), (zero, zero))
        high, low = wrapped_difference(np.array([reading]), turned)
        density = dict(terms=self._terms_buffer, waves=self._waves_buffer, kind=self._kind)
        program = self._programmer("wrap_headings", (high[0], low[0]), "score_heading", self._flags, {}, **density)
        return self._score(poses, out, program, [])

    def sample(self, poses: AnyArray, seed: int = 0, *, step: int = 0) -> np.ndarray:
        """Draw a heading from p(z | x) at each pose, on the host in float64; see ``BeamModel.sample``.

        Args:
            poses: (N, 3) or (S, N, 3) robot poses in the world [m, m, rad].
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, 0 to 2^31 - 1; each step has different random numbers.

        Returns:
            (N,) or (S, N) headings in [-pi, pi] [rad], a NumPy array of float64.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, or a seed or step beyond its limits.

        Example:
            >>> import gpusense as gs
            >>> model = gs.HeadingModel(gs.HeadingParameters(sigma=0.1), backend="numpy")
            >>> model.sample([(0.0, 0.0, 0.5)] * 3, seed=1).shape
            (3,)
        """
        p, draws = self.parameters, draws_at(poses, self._backend, seed, step)
        kind, u = draws.uniform(HEADING)
        error = von_mises(draws, HEADING, p.kappa) if p.kind == "von_mises" else p.sigma * standard_normal(u)
        turned = wrapped(wrapped(draws.poses[:, 2]) + (wrapped(np.array([p.offset])) + error))
        hit = kind * (p.z_hit + p.z_rand) < p.z_hit
        return draws.reshaped(np.where(hit, turned, math.pi * (2 * u - 1)))

    def _options(self) -> tuple[str, ...]:
        return (f"kind={self.parameters.kind!r}",)

    def _describe(self) -> tuple[str, list[Omission]]:
        p = self.parameters
        omissions = rand_omissions(p.z_rand)
        # Distance from half a turn beyond which the other turns are below exp(-40) of the nearest turn.
        near = NEGLIGIBLE * p.sigma**2 / (2 * math.pi)
        if self._kind == NEARBY and near < math.pi:
            why = f"residuals of less than pi - {near:.2g} rad need the nearest turn only"
            omissions.append(Omission("other turns", why, f"{2 * WRAPS} exp and 1 log for each such particle"))
        return f"heading, {p.kind}", omissions

    def _mixture(self) -> tuple[int, HeadingTerms, list[float]]:
        """Return the kind of density, its numbers, and the factors of its Fourier series."""
        p, real = self.parameters, self._real
        waves, decay = [0.0] * WAVES, 0.0
        log_hit, random = log_of(p.z_hit), log_weight(p.z_rand) - math.log(2 * math.pi)
        with localcontext(prec=DIGITS):
            if p.kind == "von_mises":
                from scipy.special import i0e

                # A small kappa may underflow; its density then equals that of kappa = 0.
                self._check_scale("kappa", 1 / math.sqrt(max(p.kappa, 1.0)), "1 / sqrt(kappa) ")
                kind, scale = VON_MISES, (2 * Decimal(p.kappa)).sqrt()
                peak = total(log_hit, -(2 * PI * Decimal(float(i0e(p.kappa)))).ln())
            elif p.sigma <= _WIDEST_SUM:
                self._check_scale("sigma", p.sigma)
                kind, (scale, peak) = NEARBY, normal_terms(p.sigma, log_hit)
                # Clamped to stay finite in float32; other turns vanish long before.
                decay = min(2 * math.pi / p.sigma / p.sigma, 1e30)
            else:
                kind, scale, peak = SERIES, Decimal(0), total(log_hit, -(2 * PI).ln())
                waves = [2 * math.exp(-0.5 * min(n * p.sigma, 1e3) ** 2) for n in range(1, WAVES + 1)]
        return kind, HeadingTerms(random, decay, *two_parts((scale, peak), real)), waves
