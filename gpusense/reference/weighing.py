"""Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.

w_k = v exp(b_k (l - max l)), where v is the previous weight, l the sum over sensors of temperature times log p, and b_k
= d b / 2^k a ladder of depth d. The first rung whose effective sample size (sum w)^2 / sum w^2 is at least SHARE of the
previous one is taken; the rest of b is left to the next stage of the correction (annealing: Neal, *Annealed importance
sampling*, 2001). Weights are rounded to integers below 2^53 / N, so that their sums are exact in any order.
"""

import numpy as np

from gpusense.interface.constants import (
    DEPTH,
    RUNGS,
    SCALE,
    SHARE,
    TEMPERATURE,
    WEIGHT_SUMS,
)
from gpusense.reference.tempering import largest_of, left_of, possible_of, rung_of, set_stage, tempered


def add_scores(flags, log_p, settings, score, largest, particles, block, sensor):
    """Add a sensor's log-likelihoods times its temperature to the scores, which sensor 0 begins; find block maxima."""
    scaled = settings[TEMPERATURE + sensor] * log_p[:particles].astype(np.float64)
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
    scale, old = settings[SCALE], before[:particles]
    highest[0] = largest_of(largest, 0, groups)
    likelihood = tempered(score[:particles], highest[0], left_of(state, stage) * settings[DEPTH])
    table, starts = sums[: blocks * WEIGHT_SUMS].reshape(blocks, WEIGHT_SUMS), np.arange(0, particles, block)
    table[:, 2 * RUNGS] = np.add.reduceat(np.floor(old * scale), starts)
    for rung in reversed(range(RUNGS)):
        weight = old * likelihood
        table[:, rung] = np.add.reduceat(np.floor(weight * scale), starts)
        table[:, RUNGS + rung] = np.add.reduceat(np.floor(weight * weight * scale), starts)
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
    scale, left, high = settings[SCALE], left_of(state, stage), possible_of(totals, highest[0])
    rung = rung_of(totals, settings, settings[SHARE] * particles) if left > 0.0 else 0
    likelihood = tempered(score[:particles], high, left * settings[DEPTH])
    for _ in range(rung, RUNGS - 1):
        likelihood = likelihood * likelihood
    weight[:particles] = before[:particles] * likelihood
    ends[:particles] = np.cumsum(np.floor(weight[:particles] * scale))
    set_stage(totals, settings, state, high, left, rung, particles, stage, stages)
