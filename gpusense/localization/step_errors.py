"""Compute errors of an odometer between reference poses, and their covariance by the odometry model.

Between two references there are one or more steps. The difference between reference and odometry is, to first order,
the sum of the errors of these steps, each carried to the end of the gap: a turn displaces the end by the angle times
its distance. The covariance is therefore linear in the model's variances: a sum of variances times matrices of the
path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpusense.localization.motion import SHORTEST
from gpusense.localization.pose_algebra import pose_difference, wrap_angle

# Variances of the model: alpha1 to alpha4, sideways, and the squares of the least deviations.
NOISES = ("alpha1", "alpha2", "alpha3", "alpha4", "sideways", "least translation", "least turn")
# A shorter step [m, rad] is at rest: its motion may be jitter, so it informs only the least deviations. By the
# defaults, the noise of a motion of this length has a tenth of their variances.
REST = (0.02, 0.01)


class Errors(NamedTuple):
    """Errors of G gaps along and across the motion [m], and of the heading [rad].

    Attributes:
        residual: (G, 3) errors.
        basis: (7, G, 3, 3) covariances per unit of each variance of ``NOISES``.
        design: (G, 3, 3) errors per unit of each part of the systematic error.
    """

    residual: np.ndarray
    basis: np.ndarray
    design: np.ndarray

    def covariances(self, noise: np.ndarray) -> np.ndarray:
        """Return the (G, 3, 3) covariances for (7,) variances."""
        count = len(self.residual)
        return (noise @ self.basis.reshape(len(NOISES), count * 9)).reshape(count, 3, 3)


def corrected(turns: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Return motions (M, 3) without the systematic error, corrected like :class:`OdometryMotion`."""
    stretch, gain, drift = repeated
    first, trans, second = turns.T
    half = drift * trans / 2
    return np.stack([first * (1 + gain) + half, trans * (1 + stretch), second * (1 + gain) + half], axis=1)


def errors_of(turns: np.ndarray, references: np.ndarray, at: np.ndarray) -> Errors:
    """Return the errors between (G + 1, 3) references before steps ``at``, of (M, 3) steps [rad, m, rad]."""
    first, trans, second = turns.T
    heading = np.r_[0.0, np.cumsum(first + second)]
    way = heading[:-1] + first
    x, y = (np.r_[0.0, np.cumsum(trans * part)] for part in (np.cos(way), np.sin(way)))
    path = np.stack([x, y, heading], axis=1)
    moved, truth = pose_difference(path[at[:-1]], path[at[1:]]), pose_difference(references[:-1], references[1:])
    # Along the motion between references, ahead or backwards; along the heading if there is none.
    turn = np.where(np.hypot(moved[:, 0], moved[:, 1]) < SHORTEST, 0.0, np.arctan2(moved[:, 1], moved[:, 0]))
    turn = np.where(np.abs(turn) > np.pi / 2, turn - np.copysign(np.pi, turn), turn)
    difference = truth - moved
    residual = np.column_stack([_turned(difference[:, :2], -turn), wrap_angle(difference[:, 2])])
    steps = slice(at[0], at[-1])
    gap = np.repeat(np.arange(len(moved)), np.diff(at))
    axis = (path[at[:-1], 2] + turn)[gap]
    # Line from the end of a step to the end of its gap: a turn displaces the gap's end at right angles.
    lever = _turned((path[at[1:]][gap] - path[1:][steps])[:, :2], -axis)
    carry = np.zeros((len(gap), 3, 3))
    carry[:, :2, 0] = _turned(np.tile((1.0, 0.0), (len(gap), 1)), way[steps] - axis)
    carry[:, :2, 1] = _turned(np.tile((0.0, 1.0), (len(gap), 1)), way[steps] - axis)
    carry[:, 0, 2], carry[:, 1, 2], carry[:, 2, 2] = -lever[:, 1], lever[:, 0], 1.0
    basis, design = _of_steps(turns[steps])
    first_steps = at[:-1] - at[0]
    return Errors(
        residual,
        np.add.reduceat(carry @ basis @ carry.transpose(0, 2, 1), first_steps, axis=1),
        np.add.reduceat(carry @ design, first_steps, axis=0),
    )


def _turned(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return (N, 2) vectors turned by (N,) angles."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = vectors.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def _of_steps(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return basis (7, M, 3, 3) and design (M, 3, 3) of steps, along and across their translation."""
    moving = ~at_rest(turns)
    first, trans, second = np.where(moving[:, None], turns, 0.0).T
    squares = first**2 + second**2
    basis = np.zeros((len(NOISES), len(turns), 3, 3))
    # A first turn moves the end sideways; the second turn changes only the heading.
    for noise, (one, two) in {0: (first**2, second**2), 1: (trans**2, trans**2), 6: (1.0, 1.0)}.items():
        length = turns[:, 1] if noise == 6 else trans
        basis[noise, :, 1, 1] = one * length**2
        basis[noise, :, 1, 2] = basis[noise, :, 2, 1] = one * length
        basis[noise, :, 2, 2] = one + two
    basis[2, :, 0, 0] = trans**2
    basis[3, :, 0, 0] = basis[4, :, 1, 1] = squares
    basis[5, :, 0, 0] = basis[5, :, 1, 1] = 1.0
    design = np.zeros((len(turns), 3, 3))
    design[:, 0, 0] = trans
    design[:, 1, 1], design[:, 2, 1] = trans * first, first + second
    design[:, 1, 2], design[:, 2, 2] = trans * trans / 2, trans
    return basis, design


def at_rest(turns: np.ndarray) -> np.ndarray:
    """Return the mask of steps (M, 3) that translate and turn by less than ``REST``."""
    return (np.abs(turns[:, 1]) < REST[0]) & (np.abs(wrap_angle(turns[:, 0] + turns[:, 2])) < REST[1])
