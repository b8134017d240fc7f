"""The ladder of temperatures of a correction, and the state of its stages: b_k = b / 2^k, where b is what is left.

See weighing.py.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import (
    DEGENERATE,
    INJECTED,
    LEFT,
    RESAMPLED,
    RUNG,
    RUNGS,
    SAMPLE_SIZE,
    SCALE,
    STAGE,
    THRESHOLD,
    TOTAL,
)
from gpusense.reference.elementary import exp_of


def largest_of(largest: np.ndarray, blocks: int) -> float:
    """Return the largest score of all blocks."""
    return float(largest[:blocks].max())


def tempered(score: np.ndarray, largest: float, left: float) -> np.ndarray:
    """Return the likelihoods of scores relative to the largest; 1 for all where none is possible or nothing is left."""
    if largest == -np.inf or left == 0.0:
        return np.ones_like(score)
    return exp_of(left * (score - largest))


def left_of(state: np.ndarray, stage: int) -> float:
    """Return the part of the temperature that earlier stages have left."""
    return float(state[(stage - 1) * STAGE + LEFT]) if stage > 0 else 1.0


def rung_of(totals: np.ndarray, settings: np.ndarray, least: float) -> int:
    """Return the first rung with the effective sample size ``least``, or the last rung."""
    for rung in range(RUNGS - 1):
        if totals[rung] * totals[rung] >= least * settings[SCALE] * totals[RUNGS + rung]:
            return rung
    return RUNGS - 1


def set_stage(
    totals: np.ndarray,
    settings: np.ndarray,
    state: np.ndarray,
    high: float,
    left: float,
    rung: int,
    particles: int,
    stage: int,
    stages: int,
) -> None:
    """Write the state of a stage that uses a rung."""
    size = totals[rung] * totals[rung] / (settings[SCALE] * totals[RUNGS + rung])
    rest = left - left * 0.5**rung
    state[stage * STAGE + LEFT] = rest if stage + 1 < stages else 0.0
    state[stage * STAGE + TOTAL] = totals[rung]
    state[stage * STAGE + SAMPLE_SIZE] = size
    wanted = size < settings[THRESHOLD] * particles or rest > 0.0 or (stage == 0 and state[INJECTED] > 0.0)
    state[stage * STAGE + RESAMPLED] = 1.0 if wanted else 0.0
    state[stage * STAGE + DEGENERATE] = 1.0 if high == -np.inf else 0.0
    state[stage * STAGE + RUNG] = left * 0.5**rung
