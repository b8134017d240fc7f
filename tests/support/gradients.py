"""Check gradients of log-likelihoods by differences."""

from __future__ import annotations

from typing import Any

import numpy as np


def check_gradients(problem: Any, theta: np.ndarray, tolerance: float = 1e-8) -> None:
    """Check a problem's gradients against central differences, up to a share of the largest gradient."""
    gradient = problem.log_p(theta)[1]
    for k, step in enumerate(1e-6 * problem.scales(theta)):
        ends = [problem.log_p(theta + sign * step * np.eye(len(theta))[k])[0] for sign in (1, -1)]
        size = 1 + np.abs(gradient[:, k]).max()
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), gradient[:, k], rtol=0, atol=tolerance * size)
