"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Between two stages of a correction a drawn pose moves by a fraction of the
difference of two others, whose spread is that of the cloud (differential evolution: ter Braak 2006); differences
between separate clusters are shortened. Injected poses come from a pool: free cells, or the modes of a likelihood map.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import DRAWN, FIRST, STAGE, STRATIFIED, TOTAL
from gpusense.reference.draws import copy_particle, draw_particle, found_at, is_copied, mark_of, start_of


def draw_particles(
    flags: frozenset[str],
    source: np.ndarray,
    weight: np.ndarray,
    ends: np.ndarray,
    settings: np.ndarray,
    state: np.ndarray,
    pool: np.ndarray,
    target: np.ndarray,
    after: np.ndarray,
    particles: int,
    drawn: int,
    stage: int,
) -> None:
    """Draw the particles of the next stage or step, or copy them where no resampling is due."""
    n, own = np.arange(drawn), state[stage * STAGE : (stage + 1) * STAGE]
    if is_copied(own, particles, drawn):
        copy_particle(source[: 3 * particles], weight, settings, own, target, after, particles, n)
        return
    index = n + int(settings[FIRST])
    start = start_of(settings, stage, index if settings[STRATIFIED] > 0.0 else np.zeros(1, np.uint64))
    whole = settings[DRAWN] if settings[DRAWN] > 0.0 else float(drawn)
    chosen = found_at(ends, mark_of((index + start) / whole, own[TOTAL]), particles)
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen)
