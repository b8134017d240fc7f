"""Find poses of maximal likelihood near starts by damped Gauss-Newton on a likelihood field.

Damping and the stopping rule are the same in all directions, so that ends turn with the map.
"""

from __future__ import annotations

import numpy as np

from gpusense.models.scan.field import LikelihoodFieldModel

# Most iterations, and the length and turn of a step that end them [m, rad].
_ITERATIONS, _SMALL = 50, 1e-4


def climb(
    model: LikelihoodFieldModel, ranges: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maximise the log-likelihoods of (S, K) readings from (S, 3) poses by Levenberg's damped Gauss-Newton steps."""
    scans = len(pose)
    damping, count, calm = np.full(scans, 1e-3), np.zeros(scans), np.zeros(scans, bool)
    with model._gradients(ranges) as gradients:

        def evaluated(poses: np.ndarray) -> list[np.ndarray]:
            return [numbers[:, 0].astype(np.float64) for numbers in gradients(poses[:, None])]

        value, gradient, information = evaluated(pose)
        for _ in range(_ITERATIONS):
            moving = ~calm
            if not moving.any():
                break
            step = np.linalg.solve(information + damping_of(information, damping), gradient[..., None])[..., 0]
            length = np.hypot(step[:, 0], step[:, 1])
            step *= (1 / np.maximum(1, np.maximum(length / 0.5, np.abs(step[:, 2]) / 0.3)))[:, None]
            step[calm] = 0
            trial = pose + step
            new_value, new_gradient, new_information = evaluated(trial)
            better = moving & (new_value >= value)
            pose = np.where(better[:, None], trial, pose)
            value = np.where(better, new_value, value)
            gradient = np.where(better[:, None], new_gradient, gradient)
            information = np.where(better[:, None, None], new_information, information)
            count += moving
            damping = np.clip(np.where(better, damping / 5, damping * 8), 1e-6, 1e6)
            largest = np.maximum(np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2]))
            calm |= moving & (largest < (_SMALL if model.precision == "float64" else 3 * _SMALL))
    return pose, count, calm


def damping_of(information: np.ndarray, damping: np.ndarray, least: float = 1e-6) -> np.ndarray:
    """Return diagonal matrices (S, 3, 3) that damp steps by (S, 3, 3) information, equally in x and y."""
    diagonal = np.einsum("sii->si", information).copy()
    diagonal[:, :2] = diagonal[:, :2].mean(axis=1, keepdims=True)
    return np.eye(3) * (damping[:, None] * diagonal + least * (1 + diagonal.max(axis=1))[:, None])[:, None]
