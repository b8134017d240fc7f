"""Damped Gauss-Newton (Levenberg) from poses to maxima of an interpolated likelihood field.

Damping and the stopping rule are the same in all directions, so that ends turn with the map.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import CLIMB, GRADIENT_NUMBERS
from gpusense.interface.structs import ScanBatch
from gpusense.reference.field_gradient import field_gradient
from gpusense.reference.placement import place_pose

# Places of a climb's numbers: the best pose (3), its log-likelihood, gradient (3) and information (6), the start (2),
# damping, steps, whether the last step was small, and whether the climb has ended.
VALUE, SLOPE, MATRIX, START, DAMPING, STEPS, CALM, ENDED = 3, 4, 7, 13, 15, 16, 17, 18
# Rows and columns of the information, and its places in a symmetric matrix.
_UPPER, _SYMMETRIC = np.triu_indices(3), np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
# Longest and largest step [m, rad], the farthest that a climb leads from its start [m], and the damping of a direction
# without information, relative to the largest information.
_LONGEST, _LARGEST, _FARTHEST, _LEAST = 0.5, 0.3, 5.0, 1e-6


def damped_step(climb: np.ndarray) -> np.ndarray:
    """Solve for the steps (S, 3) that damping allows, of at most the longest length and turn."""
    information = climb[:, MATRIX:START][:, _SYMMETRIC]
    diagonal = np.einsum("sii->si", information).copy()
    diagonal[:, :2] = diagonal[:, :2].mean(axis=1, keepdims=True)
    damping = climb[:, DAMPING, None] * diagonal + _LEAST * (1 + diagonal.max(axis=1, keepdims=True))
    step = np.linalg.solve(information + np.eye(3) * damping[:, None], climb[:, SLOPE:MATRIX, None])[..., 0]
    over = np.maximum(np.hypot(step[:, 0], step[:, 1]) / _LONGEST, np.abs(step[:, 2]) / _LARGEST)
    limited: np.ndarray = step / np.maximum(over, 1)[:, None]
    return limited


def climb_step(
    climb: np.ndarray, tried: np.ndarray, numbers: np.ndarray, most: int, small: float, yaw_cos: float, yaw_sin: float
) -> None:
    """Judge the poses (S, 3) that were tried by their numbers (S, 13) in the grid's frame, and write the next ones.

    Poses of climbs (S, 19) that have ended stay.
    """
    rows = np.flatnonzero(climb[:, ENDED] == 0)
    at, trial, numbers = climb[rows], tried[rows], numbers[rows].astype(np.float64)
    off, far = trial - at[:, :3], trial[:, :2] - at[:, START : START + 2]
    first = at[:, STEPS] < 0
    better = first | ((numbers[:, 0] >= at[:, VALUE]) & (np.hypot(*far.T) <= _FARTHEST))
    turned = np.array([[yaw_cos, -yaw_sin, 0], [yaw_sin, yaw_cos, 0], [0, 0, 1]])
    information = turned @ numbers[:, 4:].reshape(-1, 3, 3) @ turned.T
    judged = np.column_stack([trial, numbers[:, 0], numbers[:, 1:4] @ turned.T, information[:, _UPPER[0], _UPPER[1]]])
    at[better, :START] = judged[better]
    damping = np.clip(np.where(better, at[:, DAMPING] / 5, at[:, DAMPING] * 8), 1e-6, 1e6)
    at[:, DAMPING] = np.where(first, at[:, DAMPING], damping)
    at[:, CALM] = ~first & (np.maximum(np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])) < small)
    at[:, STEPS] += 1
    at[:, ENDED] = (at[:, CALM] != 0) | (at[:, STEPS] >= most)
    tried[rows] = at[:, :3] + np.where(at[:, ENDED, None] != 0, 0, damped_step(at))
    climb[rows] = at


def climb_field(
    flags, table, poses, climb, pose_cell, pose, pose_low, pose_status, point, point_low, terms, start, constant_terms,
    scans, readings, guard, mount_x, mount_y, resolution, score, most, small, yaw_cos, yaw_sin, frame, window,
):  # fmt: skip
    """Climb from placed poses, one a scan, and write the ends."""
    climbs, tried = climb[: CLIMB * scans].reshape(scans, CLIMB), poses[: 3 * scans].reshape(scans, 3)
    numbers = np.empty((scans, GRADIENT_NUMBERS), table.dtype)
    while not climbs[:, ENDED].all():
        field_gradient(
            flags, table, pose_cell, pose, pose_low, point, point_low, terms, start, constant_terms,
            numbers.reshape(-1), window, scans, readings, guard, mount_x, mount_y, resolution, score, ScanBatch(1, 0),
        )  # fmt: skip
        climb_step(climbs, tried, numbers, most, small, yaw_cos, yaw_sin)
        place_pose(flags, tried, pose_cell[:scans], pose[:scans], pose_low[:scans], pose_status, frame, window)
