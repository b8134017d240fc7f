"""Check the options of a particle filter, and derive the settings of its steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.interface.constants import (
    DEPTH,
    DEVIATION,
    FARTHEST_THETA,
    FARTHEST_X,
    FAST_RATE,
    INDEPENDENT,
    JITTER,
    MEAN,
    MOST_INJECTED,
    PER_BEAM_SCALE,
    POOL,
    RESIDUAL,
    REVERSE,
    SCALE,
    SEED,
    SETTINGS,
    SHARE,
    SLOW_RATE,
    STEP,
    STRATIFIED,
    SYSTEMATIC,
    TEMPERATURE,
    THRESHOLD,
)
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.motion import SampledMotion, settings_of

# Most particles.
_MOST = 1 << 24
_DRAWS = {"systematic": SYSTEMATIC, "stratified": INDEPENDENT, "residual": RESIDUAL}


class Options(NamedTuple):
    """Options of :class:`gpusense.ParticleFilter`, see there; ``particles`` are from ``least`` to ``most``."""

    least: int
    most: int
    seed: int
    temperature: float | str
    resampling: str
    threshold: float
    stages: int
    recovery: str | None
    beam_skip: float | None

    @property
    def words(self) -> tuple[int, int]:
        """The seed in two words of 32 bits."""
        return self.seed & 0xFFFFFFFF, self.seed >> 32


def _temperature(value: Any) -> float | str:
    """Check a temperature."""
    if isinstance(value, str) and value != "auto":
        raise ValueError(f"temperature: must be 'auto' or a number, got {checks.show(value)}")
    return value if isinstance(value, str) else checks.real("temperature", value, above=0, high=1)


def checked(*, particles: Any, temperature: Any, recovery: Any, beam_skip: Any, **options: Any) -> Options:
    """Check the options of a filter."""
    least, most = _counts(particles)
    return Options(
        least=least,
        most=most,
        seed=checks.integer("seed", options["seed"], low=0, high=(1 << 64) - 1),
        temperature=_temperature(temperature),
        resampling=checks.choice("resampling", options["resampling"], ("systematic", "stratified", "residual")),
        threshold=checks.real("threshold", options["threshold"], above=0, high=1),
        stages=checks.integer("stages", options["stages"], low=1, high=6),
        recovery=None if recovery is None else checks.choice("recovery", recovery, ("augmented", "sensor")),
        beam_skip=None if beam_skip is None else checks.real("beam_skip", beam_skip, above=0, below=1),
    )


def _counts(particles: Any) -> tuple[int, int]:
    """Return the least and the largest number of particles."""
    pair = particles if isinstance(particles, (tuple, list)) else (particles, particles)
    if len(pair) != 2:
        raise ValueError(f"particles: must be a number or (least, most), got {checks.show(particles)}")
    least, most = (checks.integer("particles", value, low=1, high=_MOST) for value in pair)
    if least > most:
        raise ValueError(f"particles: least must be at most the largest, got {checks.show(particles)}")
    return least, most


def settings_of_step(
    options: Options,
    motion: SampledMotion,
    step: int,
    count: int,
    pool: tuple[int, tuple[float, float, float]],
    sensors: Sequence[tuple[float, int]],
    one_peak: bool,
) -> np.ndarray:
    """Return the settings of a step, indexed by ``interface.constants``; sensors are temperatures and beams."""
    settings = _settings_of_run(options, count, pool, tuple(sensors), one_peak).copy()
    settings[STEP] = step
    settings[MEAN : DEVIATION + 4], settings[REVERSE] = settings_of(motion)
    return settings


@functools.lru_cache(maxsize=32)
def _settings_of_run(
    options: Options,
    count: int,
    pool: tuple[int, tuple[float, float, float]],
    sensors: tuple[tuple[float, int], ...],
    one_peak: bool,
) -> np.ndarray:
    """Return the settings common to all steps; arguments as for ``settings_of_step``."""
    s: list[float] = [0.0] * SETTINGS
    s[SEED], s[SEED + 1] = options.words
    s[JITTER], s[FARTHEST_X], s[FARTHEST_THETA] = DEFAULTS.jitter, DEFAULTS.farthest, DEFAULTS.farthest_turn
    s[POOL], s[POOL + 1 : POOL + 4] = pool
    s[SHARE] = min(DEFAULTS.share, DEFAULTS.enough / count) if one_peak else DEFAULTS.share_apart
    s[THRESHOLD] = options.threshold
    s[DEPTH] = 1.0
    s[STRATIFIED] = _DRAWS[options.resampling]
    # Sums of weights stay below 2^53: a weight is 1 on average, and its square at most 1 / threshold. An effective
    # sample size of one particle exceeds any lower threshold.
    threshold = max(options.threshold, 1 / _MOST)
    spare = math.ceil(math.log2(max(count, 2))) + math.ceil(-math.log2(threshold)) + 2
    s[SCALE] = 2.0 ** (52 - spare)
    if options.recovery == "augmented":
        s[SLOW_RATE], s[FAST_RATE] = DEFAULTS.slow, DEFAULTS.fast
        s[MOST_INJECTED] = DEFAULTS.most_injected
    total = 0.0
    for place, (temperature, beams) in enumerate(sensors):
        s[TEMPERATURE + place] = temperature
        total += temperature * max(beams, 1)
    s[PER_BEAM_SCALE] = 1 / total if total > 0 else 0.0
    return np.array(s, np.float64)
