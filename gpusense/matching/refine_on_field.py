"""Find poses of maximal likelihood near starts by damped Gauss-Newton on a likelihood field.

Damping and the stopping rule are the same in all directions, so that ends turn with the map.
"""

from __future__ import annotations

import numpy as np

from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.reference.field_climb import CALM, STEPS

# Length and turn of a step that end a climb [m, rad], by precision.
_SMALL = {"float64": 1e-4, "float32": 3e-4}


def climb(
    model: LikelihoodFieldModel, ranges: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maximise the log-likelihoods of (S, K) readings from (S, 3) poses by Levenberg's damped Gauss-Newton steps.

    Return the poses, their steps, and whether the last step was small.
    """
    end = model._climb(np.asarray(pose, np.float64), ranges, _SMALL[model.precision])
    return end[:, :3], end[:, STEPS], end[:, CALM] > 0


def damping_of(information: np.ndarray, damping: np.ndarray, least: float = 1e-6) -> np.ndarray:
    """Return diagonal matrices (S, 3, 3) that damp steps by (S, 3, 3) information, equally in x and y."""
    diagonal = np.einsum("sii->si", information).copy()
    diagonal[:, :2] = diagonal[:, :2].mean(axis=1, keepdims=True)
    return np.eye(3) * (damping[:, None] * diagonal + least * (1 + diagonal.max(axis=1))[:, None])[:, None]
