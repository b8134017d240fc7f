"""Check options of a particle filter, derive settings of its steps, and hold its state as plain data."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.interface import constants as c
from gpusense.localization.cloud_state import Contents
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.motion import SampledMotion, settings_of
from gpusense.localization.sensors import Sensor

# Most particles.
_MOST = 1 << 24
_DRAWS = {"systematic": c.SYSTEMATIC, "stratified": c.INDEPENDENT, "residual": c.RESIDUAL}


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


def checked_options(*, particles: Any, temperature: Any, recovery: Any, beam_skip: Any, **options: Any) -> Options:
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
    settings[c.STEP] = step
    settings[c.MEAN : c.DEVIATION + 4], settings[c.REVERSE] = settings_of(motion)
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
    s: list[float] = [0.0] * c.SETTINGS
    s[c.SEED], s[c.SEED + 1] = options.words
    s[c.JITTER], s[c.FARTHEST_X], s[c.FARTHEST_THETA] = DEFAULTS.jitter, DEFAULTS.farthest, DEFAULTS.farthest_turn
    s[c.POOL], s[c.POOL + 1 : c.POOL + 4] = pool
    s[c.SHARE] = min(DEFAULTS.share, DEFAULTS.enough / count) if one_peak else DEFAULTS.share_apart
    s[c.THRESHOLD] = options.threshold
    s[c.DEPTH] = 1.0
    s[c.STRATIFIED] = _DRAWS[options.resampling]
    # Sums of weights stay below 2^53: a weight is 1 on average, and its square at most 1 / threshold. An effective
    # sample size of one particle exceeds any lower threshold.
    threshold = max(options.threshold, 1 / _MOST)
    spare = math.ceil(math.log2(max(count, 2))) + math.ceil(-math.log2(threshold)) + 2
    s[c.SCALE] = 2.0 ** (52 - spare)
    if options.recovery == "augmented":
        s[c.SLOW_RATE], s[c.FAST_RATE] = DEFAULTS.slow, DEFAULTS.fast
        s[c.MOST_INJECTED] = DEFAULTS.most_injected
    total = 0.0
    for place, (temperature, beams) in enumerate(sensors):
        s[c.TEMPERATURE + place] = temperature
        total += temperature * max(beams, 1)
    s[c.PER_BEAM_SCALE] = 1 / total if total > 0 else 0.0
    return np.array(s, np.float64)


@dataclass(frozen=True, eq=False)
class FilterState:
    """State of a :class:`ParticleFilter`: particles, weights, step, options, and everything learned.

    It holds no device and no models, and pickles. A filter with the same models and options continues from it, after
    ``restore``, with the same bits as the original.

    Attributes:
        options: Keyword arguments of the filter's constructor.
        models: Names of the classes of its models.
        contents: Particles on the host.
        memory: Everything else: learned temperature, recent verdicts, number of the step.

    Example:
        >>> import gpusense as gs, pickle
        >>> model = gs.HeadingModel(backend="numpy")
        >>> pf = gs.ParticleFilter(model, particles=500, seed=1)
        >>> pf.initialize_uniform(bounds=((0.0, 0.0), (5.0, 5.0)))
        >>> state = pickle.loads(pickle.dumps(pf.state()))
        >>> other = gs.ParticleFilter(model, **state.options); other.restore(state); state
        FilterState(500 particles, step=1, models=HeadingModel)
    """

    options: dict[str, Any]
    models: tuple[str, ...]
    contents: Contents
    memory: dict[str, Any]

    def __repr__(self) -> str:
        return f"FilterState({len(self.particles)} particles, step={self.step}, models={', '.join(self.models)})"

    @property
    def particles(self) -> np.ndarray:
        """(N, 3) poses after the last step."""
        return self.contents.poses

    @property
    def weights(self) -> np.ndarray:
        """(N,) normalised weights."""
        return np.asarray(self.contents.weights / self.contents.weights.sum())

    @property
    def step(self) -> int:
        """Number of the last step, a key of random numbers."""
        return int(self.memory["tracker"]["progress"].step)


def constructor_options(options: Options, motion: Any) -> dict[str, Any]:
    """Return the keyword arguments of a filter with these options."""
    rest = options._asdict()
    least, most = rest.pop("least"), rest.pop("most")
    return {"motion": motion, "particles": most if least == most else (least, most), **rest}


def model_names(sensors: Sequence[Sensor]) -> tuple[str, ...]:
    """Return the names of the classes of models."""
    return tuple(type(sensor.model).__name__ for sensor in sensors)


def check_state(state: object, options: dict[str, Any], models: tuple[str, ...]) -> FilterState:
    """Check that a state belongs to a filter with these options and models; the motion model may differ."""
    checked = checks.instance("state", state, FilterState)
    if checked.models != models:
        raise ValueError(f"state: must be of a filter of {', '.join(models)}, got one of {', '.join(checked.models)}")
    for name, value in options.items():
        if name != "motion" and checked.options.get(name) != value:
            raise ValueError(f"state: {name} must be {value!r} as in the filter, got {checked.options.get(name)!r}")
    return checked
