"""The ladder of temperatures of a correction, b_k = d b / 2^k with b the part that is left, and its stages' state.

The depth d is 1. If the last rung leaves too few particles, the host repeats the stage with a smaller d.

See weighing.py.

Recovery: augmented MCL, *Probabilistic Robotics* table 8.3, with the mean likelihood per beam.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import constants as c
from gpusense.reference.elementary import exp_of, log_of


def largest_of(largest: np.ndarray, begin: int, end: int) -> float:
    """Return the largest of the scores from begin to before end."""
    return float(largest[begin:end].max())


def possible_of(totals: np.ndarray, largest: float) -> float:
    """Return the largest score; -inf if all particles with a weight are impossible next to particles without."""
    return largest if totals[c.RUNGS - 1] > 0.0 else -np.inf


def column_of(high: float, rung: int) -> int:
    """Return the column of sums with the weights of a rung, or of the previous weights where none is possible."""
    return 2 * c.RUNGS if high == -np.inf else rung


def tempered(score: np.ndarray, largest: float, left: float) -> np.ndarray:
    """Return the likelihoods of scores relative to the largest on the last rung.

    They are 1 for all where none is possible or nothing is left. Their squares belong to the rung before: an error of
    2^-53 grows to 2^-46 on the first rung.
    """
    if largest == -np.inf or left == 0.0:
        return np.ones_like(score)
    return exp_of(c.LOWEST * left * (score - largest))


def left_of(state: np.ndarray, stage: int) -> float:
    """Return the part of the temperature that earlier stages have left."""
    return float(state[(stage - 1) * c.STAGE + c.LEFT]) if stage > 0 else 1.0


def rung_of(totals: np.ndarray, settings: np.ndarray, least: float) -> int:
    """Return the first rung with the effective sample size ``least``, or the last rung."""
    for rung in range(c.RUNGS - 1):
        if totals[rung] * totals[rung] >= least * settings[c.SCALE] * totals[c.RUNGS + rung]:
            return rung
    return c.RUNGS - 1


def follow_evidence(total: float, before: float, largest: float, settings: np.ndarray, state: np.ndarray) -> None:
    """Update the averages of the likelihood per beam, and the share of particles to inject."""
    if largest == -np.inf or not total > 0.0 or not before > 0.0:
        return
    evidence = largest + float(log_of(np.array(total / before)))
    mean = float(exp_of(np.array(min(settings[c.PER_BEAM_SCALE] * evidence, 700.0))))
    first = state[c.SLOW] == 0.0
    state[c.EVIDENCE] = evidence
    state[c.SLOW] = mean if first else state[c.SLOW] + settings[c.SLOW_RATE] * (mean - state[c.SLOW])
    state[c.FAST] = mean if first else state[c.FAST] + settings[c.FAST_RATE] * (mean - state[c.FAST])
    share = 1.0 - state[c.FAST] / state[c.SLOW] if state[c.SLOW] > 0.0 else 0.0
    state[c.INJECTED] = min(max(share, 0.0), settings[c.MOST_INJECTED])


def set_stage(
    totals: np.ndarray, settings: np.ndarray, state: np.ndarray, high: float, left: float, rung: int, particles: int,
    stage: int, stages: int,
) -> None:  # fmt: skip
    """Write the state of a stage that uses a rung; at stage 0, follow the evidence of the whole temperature."""
    if stage == 0 and settings[c.DEPTH] == 1.0:
        follow_evidence(totals[0], totals[2 * c.RUNGS], high, settings, state)
    with np.errstate(invalid="ignore"):
        size = totals[rung] * totals[rung] / (settings[c.SCALE] * totals[c.RUNGS + rung])
    part = left * settings[c.DEPTH] * 0.5**rung
    rest = left - part
    state[stage * c.STAGE + c.LEFT] = rest if stage + 1 < stages else 0.0
    state[stage * c.STAGE + c.TOTAL] = totals[column_of(high, rung)]
    state[stage * c.STAGE + c.SAMPLE_SIZE] = size
    wanted = size < settings[c.THRESHOLD] * particles or rest > 0.0 or (stage == 0 and state[c.INJECTED] > 0.0)
    state[stage * c.STAGE + c.RESAMPLED] = 1.0 if wanted else 0.0
    state[stage * c.STAGE + c.DEGENERATE] = 1.0 if high == -np.inf else 0.0
    state[stage * c.STAGE + c.RUNG] = part
