"""Tolerances with their reasons: the one table that the tests, ``gpusense selftest`` and the pages use.

A float32 result is never compared with the float64 result of the same call: their inputs are rounded differently, and a
ray that grazes a corner may then end at another wall. Ranges are compared bit by bit across devices. A likelihood is
compared with the float64 reference kernel *on the float32 launch's rounded inputs and expected ranges* (see
``replay.replay``). Two devices that each keep a bound against that truth differ by at most twice the bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from gpusense._util.typing import Reals
from gpusense.interface.constants import BLOCK_TERMS

_EPS = float(np.finfo(np.float32).eps)
_COUNTED = ("cells that differ", "values with other bits", "beams in another cell")


@dataclass(frozen=True)
class Tolerance:
    """Largest difference allowed for one quantity.

    Attributes:
        unit: Unit of the difference; eps is float32's, 1.2e-7.
    """

    name: str
    value: float
    unit: str
    reason: str

    def twice(self) -> Tolerance:
        """Return the tolerance between two results that each keep this one against the truth."""
        return Tolerance(self.name, 2 * self.value, self.unit, f"both sides keep half of it: {self.reason}")

    def difference(self, computed: ArrayLike, truth: ArrayLike) -> float:
        """Return the largest difference of two arrays of one shape in the tolerance's unit.

        In units that count, bits are compared: NaN equals NaN, and -0 does not equal 0. In other units equal values
        differ by 0, including infinite ones; a NaN, or an infinity on one side only, gives an infinite difference.
        """
        if self.unit in _COUNTED:
            return differing(computed, truth)
        a, b = np.asarray(computed, np.float64), np.asarray(truth, np.float64)
        if a.shape != b.shape:
            return math.inf
        with np.errstate(all="ignore"):
            apart = np.abs(a - b) / self.sizes(np.abs(b))
        apart = np.where(np.isnan(apart) | (np.isinf(a) != np.isinf(b)), np.inf, apart)
        return float(np.max(np.where(a == b, 0.0, apart), initial=0.0))

    def sizes(self, size: Reals) -> Reals:
        """Return the tolerance's unit at each magnitude."""
        if self.unit == "relative":
            return size
        scale = _EPS if self.unit.startswith("eps") else 1.0
        return scale * (1 + size if "|log p" in self.unit else np.ones_like(size))


_ALL = (
    Tolerance("distance transform", 0, "cells that differ", "squared distances are integers, found exactly"),
    Tolerance("empty squares", 0, "cells that differ", "shorter sides of empty rectangles are integers, found exactly"),
    Tolerance(
        "cosines and sines of headings", 0.9, "ulps of float64",
        "half an ulp of the last sum, and up to 0.4 from the rounding of its terms and the polynomials",
    ),
    Tolerance(
        "exp, 1 - exp and log in lanes", 1.1, "ulps of float32",
        "half an ulp of the last operation, and the rounding of its terms and the polynomials",
    ),
    Tolerance(
        "erf in lanes", 4, "ulps of float32",
        "1 - exp(-x W(x)): W and its product with x lose three ulps, and both count where x is small",
    ),
    Tolerance(
        "float32 ranges", 0, "values with other bits",
        "+, -, *, / and floor round alike on every device, nothing is contracted; sines and cosines use only these",
    ),
    Tolerance(
        "float64 ranges", 1e-12, "relative",
        "a crossing distance is (k + a) / |d|: four roundings of 1.1e-16 and the conditioning of the direction",
    ),
    Tolerance("float32 ranges to float64", 1e-3, "cells", "rounded inputs, for a ray that grazes nothing"),
    Tolerance(
        "float32 beam", 16, "eps (1 + |log p_k|)",
        "exp, log, tanh and division within a few eps, erf within 16 eps (OpenCL), u^2 / 2 within 3 eps of itself",
    ),
    Tolerance("float64 beam", 1e-11, "1 + |log p_k|", "a few eps, with room for drivers whose erf or tanh is poor"),
    Tolerance("float32 scan, K = 1000", 2e-3, "nats", "changes a particle's weight by less than 0.2 %"),
    Tolerance("float32 scan, K = 10 000", 1e-2, "nats", "changes a particle's weight by less than 1 %"),
    Tolerance("float64 scan", 1e-11, "1 + |log p|", "a few eps a beam, and a compensated sum"),
    Tolerance(
        "field look-ups", 0, "beams in another cell",
        "end points near a cell's edge are found again with twice the digits, so float32 hits the cells of float64; "
        "nearer than 1e-13 cells per cell of range twice the digits cannot tell, and either cell is right",
    ),
    Tolerance(
        "landmark", 16, "eps (1 + |log p_k|) of the precision",
        "exponents and angles in two numbers; exp, log, log1p and erf add a few eps",
    ),
    Tolerance(
        "normals of straight walls, mean", 1, "degrees",
        "the error of a line through 17 sides of a wall's cells: half a cell of steps at its ends",
    ),
    Tolerance("normals of straight walls, largest", 6, "degrees", "a step of a wall that is almost along an axis"),
    Tolerance(
        "float32 angles of incidence", 8, "eps",
        "directions and normals have the same bits everywhere; arc tangents of OpenCL are within 6 ulps",
    ),
    Tolerance("float64 angles of incidence", 1e-14, "rad", "arc tangents of OpenCL are within 6 ulps"),
    Tolerance("specialize=False, float32", 32, "eps (1 + |log p_k|)", "both keep the bound of one beam"),
    Tolerance("specialize=False, float64", 2e-11, "1 + |log p_k|", "both keep the bound of one beam"),
    Tolerance(
        "float64 sums to learn from", 1e-12, "relative",
        "a few eps a pair, added in blocks with compensation; relative to the largest sum of squares",
    ),
    Tolerance(
        "float32 sums to learn from", 2e-5, "relative",
        "a pair's terms carry the rounding of z, z* and sigma to float32, amplified by u^2",
    ),
    Tolerance(
        "learned parameters", 1e-6, "relative",
        "float64 on every backend: EM ends within 1e-8 nats of the optimum, by the same iterates everywhere",
    ),
    Tolerance(
        "exact EM falls", 1e-9, "|log-likelihood|", "rounding of sums; a step that does not gain is rejected",
    ),
    Tolerance("batching, order, repetition", 0, "values with other bits", "one work-item scores a particle by itself"),
)  # fmt: skip

TOLERANCES: dict[str, Tolerance] = {tolerance.name: tolerance for tolerance in _ALL}
"""Every tolerance by its name."""


@dataclass(frozen=True)
class Check:
    """One comparison.

    Attributes:
        right: Selection string of another backend, or the name of the truth.
    """

    left: str
    right: str
    quantity: str
    difference: float
    tolerance: Tolerance

    @classmethod
    def of(cls, left: str, right: str, quantity: str, computed: Any, truth: Any, tolerance: Tolerance) -> Check:
        """Compare a computed array with the truth."""
        return cls(left, right, quantity, tolerance.difference(computed, truth), tolerance)

    @property
    def passed(self) -> bool:
        """Return whether the difference is allowed."""
        return self.difference <= self.tolerance.value


def beam_tolerance(dtype: DTypeLike) -> Tolerance:
    """Return the tolerance of one beam's log-likelihood in a precision."""
    return TOLERANCES[f"{np.dtype(dtype).name} beam"]


def scan_tolerance(dtype: DTypeLike, beams: int) -> Tolerance:
    """Return the tolerance of a scan's log-likelihood in an ordinary scene.

    In a scene where beams have |log p_k| in the thousands, float32 cannot represent the sum to 2e-3 nats;
    :func:`per_scan` bounds the error there.
    """
    if np.dtype(dtype) == np.float64:
        return TOLERANCES["float64 scan"]
    if beams > 10_000:
        raise ValueError(f"beams: must be <= 10000 for a float32 scan, got {beams}; per_scan bounds longer ones")
    return TOLERANCES["float32 scan, K = 1000" if beams <= 1000 else "float32 scan, K = 10 000"]


def per_beam(log_p: ArrayLike, dtype: DTypeLike) -> Reals:
    """Return the largest error allowed of each beam's log-likelihood [nats]; infinite ones must be exact."""
    tolerance, size = beam_tolerance(dtype), np.abs(np.asarray(log_p, np.float64))
    return np.where(np.isfinite(size), tolerance.value * tolerance.sizes(size), 0.0)


def per_scan(parts: ArrayLike, dtype: DTypeLike, *, fixed: float = 0.0, temperature: float = 1.0) -> Reals:
    """Return the largest error of a scan's log-likelihood that follows from its beams' bounds and from the summation.

    BLOCK_TERMS terms are added plainly, with an error of (BLOCK_TERMS - 1) / 2 eps of the sum of their magnitudes.
    Blocks are added with compensation; its relative error is the square of a plain sum's. The final sum and its
    product with the temperature round once each. float64 has a separate, wider rule.

    Returns:
        (...) float64 [nats]; 0 where a beam's log-likelihood is infinite.
    """
    terms = np.asarray(parts, np.float64)
    possible = np.isfinite(terms).all(axis=-1)
    terms = np.where(np.isfinite(terms), terms, 0.0)
    if np.dtype(dtype) == np.float64:
        total = np.abs(temperature * (terms.sum(axis=-1) + fixed))
        return np.where(possible, TOLERANCES["float64 scan"].value * (1 + total), 0.0)
    half = _EPS / 2
    blocks = terms.shape[-1] / BLOCK_TERMS + 1
    magnitude = np.abs(terms).sum(axis=-1) + abs(fixed)
    summation = (BLOCK_TERMS - 1 + 3 + blocks * blocks * half) * half * magnitude
    return np.where(possible, temperature * (per_beam(terms, dtype).sum(axis=-1) + summation), 0.0)


def differing(left: ArrayLike, right: ArrayLike) -> int:
    """Count the values of two arrays that differ in their bits; NaN equals NaN, and 0 differs from -0."""
    a, b = np.asarray(left), np.asarray(right)
    if a.dtype != b.dtype or a.shape != b.shape:
        return max(a.size, b.size, 1)
    same = (a == b) & (np.signbit(a) == np.signbit(b)) if a.dtype.kind == "f" else a == b
    if a.dtype.kind == "f":
        same |= np.isnan(a) & np.isnan(b)
    return int(np.count_nonzero(~same))
