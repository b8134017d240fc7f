"""Number the blocks of correlated readings, and compute standard errors from the information."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers

# Scaled information below this share of the largest counts as none.
_FLAT = 1e-10
# Standard errors over fewer blocks are rough.
FEW_BLOCKS = 10


def number_blocks(blocks: object, shape: tuple[int, ...], of: NDArray[Any]) -> Integers | None:
    """Return the blocks of the used readings ``of`` (flat indices or mask), numbered from 0; None without blocks."""
    if blocks is None:
        return None
    labels: Integers = checks.array("blocks", blocks, shape, dtype=np.int64).ravel()
    known, numbers = np.unique(labels[of], return_inverse=True)
    if len(known) < 2:
        raise ValueError(f"blocks: must be at least 2 with a reading that is not missing, got {len(known)}")
    return numbers.ravel().astype(np.int64)


def notes_on_blocks(count: int) -> list[str]:
    """Return a note on standard errors over few blocks."""
    if count >= FEW_BLOCKS:
        return []
    return [f"standard errors are rough, from {count} {'block' if count == 1 else 'blocks'}"]


def scaled_axes(curve: Floats, least: float = 1e-300) -> tuple[Floats, Floats, Floats]:
    """Return (m,) scales of an (m, m) curvature to a unit diagonal (at least ``least``), its eigenvalues and axes."""
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(curve)), least))
    size, axes = np.linalg.eigh(curve * np.outer(scale, scale))
    return scale, size, axes


def errors_of(curve: Floats, rows: Floats, scatter: Floats | None = None, flat: float = _FLAT) -> Floats:
    """Compute (p,) standard errors of functions with (p, m) derivatives ``rows``, infinite without information.

    The covariance of the coordinates is the inverse of the information H, or ``H^-1 S H^-1`` with the scatter S of the
    gradient over blocks (White 1982; Liang and Zeger 1986). Scaled information below the share ``flat`` counts as none.
    """
    if not len(curve):
        return np.full(len(rows), math.nan)
    scale, size, axes = scaled_axes(curve)
    known = size > flat * max(float(size[-1]), 0.0)
    errors = np.empty(len(rows))
    for k, row_of in enumerate(rows):
        row: Floats = axes.T @ (scale * row_of)
        unknown = np.abs(row[~known]) > math.sqrt(flat) * max(float(np.abs(row).max()), 1e-300)
        errors[k] = math.inf if unknown.any() else _error(row, size, known, scale[:, None] * axes, scatter)
    return errors


def scatter_of(sums: Floats) -> Floats:
    """Return the (m, m) scatter of the (B, m) gradients of blocks, centred; NaN for fewer than 2 blocks."""
    blocks, size = sums.shape
    if blocks < 2:
        return np.full((size, size), math.nan)
    off = sums - sums.sum(axis=0) / blocks
    return (off.T @ off) * (blocks / (blocks - 1))


def _error(row: Floats, size: Floats, known: NDArray[np.bool_], axes: Floats, scatter: Floats | None) -> float:
    """Return the error of a parameter from its (m,) derivatives along the (m, m) axes and the information there."""
    if scatter is None:
        return math.sqrt(float((row[known] ** 2 / size[known]).sum()))
    influence = axes[:, known] @ (row[known] / size[known])
    return math.sqrt(max(float(influence @ scatter @ influence), 0.0)) if np.isfinite(scatter).all() else math.nan
