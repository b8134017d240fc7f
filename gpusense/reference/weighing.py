"""Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.

w_k = v exp(b_k (l - max l)), where v is the previous weight, l the sum over sensors of temperature times log p, and b_k
= d b / 2^k a ladder of depth d. The first rung whose effective sample size (sum w)^2 / sum w^2 is at least SHARE of the
previous one is taken; the rest of b is left to the next stage of the correction (annealing: Neal, *Annealed importance
sampling*, 2001). Weights are rounded to integers below 2^53 / N, so that their sums are exact in any order.

The depth d is 1. If the last rung leaves too few particles, the host repeats the stage with a smaller d. Recovery:
augmented MCL, *Probabilistic Robotics* table 8.3, with the mean likelihood per beam.
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


def add_scores(flags, log_p, settings, score, largest, particles, block, sensor):
    """Add a sensor's log-likelihoods times its temperature to the scores, which sensor 0 begins; find block maxima."""
    scaled = settings[c.TEMPERATURE + sensor] * log_p[:particles].astype(np.float64)
    score[:particles] = scaled if sensor == 0 else score[:particles] + scaled
    starts = np.arange(0, particles, block)
    largest[: len(starts)] = np.maximum.reduceat(score[:particles], starts)


def join_scores(flags, scores, largest, blocks, fan):
    """Find the largest score of every ``fan`` blocks."""
    starts = np.arange(0, blocks, fan)
    largest[: len(starts)] = np.maximum.reduceat(scores[:blocks], starts)


def weigh_particles(
    flags, score, before, largest, settings, state, sums, highest, particles, block, blocks, groups, stage,
):  # fmt: skip
    """Sum the integer weights of each block on each rung, their squares, and the previous weights."""
    scale, old = settings[c.SCALE], before[:particles]
    highest[0] = largest_of(largest, 0, groups)
    likelihood = tempered(score[:particles], highest[0], left_of(state, stage) * settings[c.DEPTH])
    table, starts = sums[: blocks * c.WEIGHT_SUMS].reshape(blocks, c.WEIGHT_SUMS), np.arange(0, particles, block)
    table[:, 2 * c.RUNGS] = np.add.reduceat(np.floor(old * scale), starts)
    for rung in reversed(range(c.RUNGS)):
        weight = old * likelihood
        table[:, rung] = np.add.reduceat(np.floor(weight * scale), starts)
        table[:, c.RUNGS + rung] = np.add.reduceat(np.floor(weight * weight * scale), starts)
        likelihood = likelihood * likelihood


def join_rows(flags, sums, joined, rows, columns, fan):
    """Add up every ``fan`` rows of sums in order; a row becomes the sum of the rows before it in its group."""
    table = sums[: rows * columns].reshape(rows, columns)
    for group, begin in enumerate(range(0, rows, fan)):
        part = table[begin : begin + fan]
        upto = np.cumsum(part, axis=0)
        joined[group * columns : (group + 1) * columns] = upto[-1]
        part[0], part[1:] = 0.0, upto[:-1]


def set_weights(
    flags, score, before, highest, sums, joined, totals, settings, state, weight, ends, particles, block, blocks,
    fan, stage, stages,
):  # fmt: skip
    """Choose the rung, set the weights and their exact cumulative sums, and write the stage's state."""
    scale, left, high = settings[c.SCALE], left_of(state, stage), possible_of(totals, highest[0])
    rung = rung_of(totals, settings, settings[c.SHARE] * particles) if left > 0.0 else 0
    likelihood = tempered(score[:particles], high, left * settings[c.DEPTH])
    for _ in range(rung, c.RUNGS - 1):
        likelihood = likelihood * likelihood
    weight[:particles] = before[:particles] * likelihood
    ends[:particles] = np.cumsum(np.floor(weight[:particles] * scale))
    set_stage(totals, settings, state, high, left, rung, particles, stage, stages)
