"""Track the robot by particles: motion, weighing, and settings of each step.

A filter has one tracker for its particles and another for the rival.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.localization import starts
from gpusense.localization.cloud import Cloud
from gpusense.localization.cloud_state import Contents
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.estimates import covariance_of, sample_size_of
from gpusense.localization.journal import plain_state, set_state
from gpusense.localization.motion import STILL, SampledMotion
from gpusense.localization.sensors import Sensor, SensorReadings
from gpusense.localization.spread import WIDE, Spread, spread_of
from gpusense.localization.state import Options, settings_of_step

# Bins of the cloud [m, rad], error bound of its density, and normal quantile of the bound's probability.
BIN, BIN_TURN = 0.5, math.radians(10)
ERROR, QUANTILE = 0.02, 2.326
# Interval between checks that a converged filter is still converged [corrections].
_LOOK = 5


class Progress(NamedTuple):
    """Progress of the particles in time; immutable, replaced by one assignment."""

    step: int = 0  # number of the last step; starts, motions, and corrections without a motion begin steps
    motion: SampledMotion | None = None  # the postponed motion, to share a program with the correction
    # Mean motion since the last correction, as a pose; None without a motion.
    moved: tuple[float, float, float] | None = None
    copies: bool = False  # whether the last correction weighed particles drawn since the last motion


class Tracker:
    """Particles with the sensors that weigh them."""

    MEMORY: ClassVar[tuple[str, ...]] = (
        "started", "progress", "shown", "wide", "together", "pool", "corrections",
    )  # fmt: skip

    def __init__(self, sensors: Sequence[Sensor], options: Options, cloud: Cloud) -> None:
        self.sensors, self.options, self.cloud = sensors, options, cloud
        self._models = [sensor.model for sensor in sensors]
        # Number of shown particles, from the last step; number of remaining corrections at a low temperature.
        self.started, self.progress, self.shown, self.wide = False, Progress(), options.most, 0
        # True if the particles are known to be concentrated; number of corrections.
        self.together, self.corrections = False, 0
        # The last result of ``described``.
        self._moments: tuple[np.ndarray, tuple[np.ndarray, np.ndarray], Spread] | None = None
        # Number of poses for recovery to inject, and half widths of the box around each.
        self.pool: tuple[int, starts.Spread] = 0, (0.0, 0.0, 0.0)

    # ---- particles

    def check_started(self) -> None:
        """Refuse to continue without particles."""
        if not self.started:
            raise RuntimeError(
                "ParticleFilter: must be initialised first, by initialize, initialize_uniform or initialize_from"
            )

    def key(self) -> starts.Key:
        """Return the two words of the seed, and the number of a new step."""
        self.progress = self.progress._replace(step=self.progress.step + 1)
        return *self.options.words, self.progress.step

    def number(self, particles: int | None) -> int:
        """Return a checked number of particles; None gives the most."""
        most = self.options.most
        return most if particles is None else checks.integer("particles", particles, low=1, high=most)

    def begin(self, poses: np.ndarray) -> None:
        """Replace all particles, and forget the motion of the previous ones."""
        self.progress = Progress(self.progress.step)
        self.place(poses)

    def place(self, poses: np.ndarray) -> None:
        """Replace all particles."""
        self.cloud.place(poses)
        self.shown, self.started, self.wide, self.together = len(poses), True, 0, False
        if self.options.recovery == "augmented" and not self.pool[0]:
            pool, spread = starts.free_pool(self._models, None)
            self.cloud.set_pool(pool)
            self.pool = len(pool), spread

    def random_poses(self, count: int) -> np.ndarray:
        """Return poses in free space, or around the particles without a grid; deterministic."""
        try:
            pool, spread = starts.free_pool(self._models, None)
        except ValueError:
            pool, spread = self.host_particles().mean(axis=0)[None], (10.0, 10.0, math.pi)
        return starts.spread(pool, spread, count, (*self.options.words, 0))

    def host_particles(self) -> np.ndarray:
        """Return a copy of the shown poses."""
        return self.cloud.host_poses(self.cloud.places.shown, self.shown)

    def moved_particles(self) -> tuple[np.ndarray, np.ndarray]:
        """Run a postponed motion; return copies of the particles' poses and weights."""
        self.move()
        return self.host_particles(), self.host_weights()

    def next_particles(self) -> np.ndarray:
        """Return a copy of the poses of the next step."""
        return self.cloud.host_poses(self.cloud.places.next, self.cloud.count)

    def host_weights(self) -> np.ndarray:
        """Return a copy of the normalised weights of the shown particles."""
        weights = self.cloud.host_weights(self.shown)
        return weights / weights.sum()

    def mean_and_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the shown particles, arrays that do not change."""
        return self.described()[1]

    def described(self) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], Spread]:
        """Return the estimate from the kernels, its mean and covariance, and the covariance's spread."""
        numbers, known = self.cloud.estimate(self.shown), self._moments
        if known is None or known[0] is not numbers:
            covariance = covariance_of(numbers)
            known = self._moments = numbers, (numbers[:3], covariance), spread_of(covariance)
        return known

    # ---- state

    def state(self) -> tuple[Contents, dict[str, Any]]:
        """Return particles and memory as plain data."""
        return self.cloud.contents(self.shown), plain_state(self)

    def restore(self, contents: Contents, memory: Mapping[str, Any]) -> None:
        """Take over particles and memory."""
        self.cloud.restore(contents)
        set_state(self, memory)

    # ---- steps

    def follow(self, motion: SampledMotion) -> None:
        """Postpone a motion to share the next correction's program."""
        if self.progress.motion is not None:
            self.move()
        now = self.progress
        moved = motion.after(now.moved or (0.0, 0.0, 0.0))
        self.progress = Progress(now.step + 1, motion, moved, now.copies)

    def move(self) -> None:
        """Run a postponed motion."""
        if (motion := self.progress.motion) is not None:
            self.cloud.move(self.settings(motion, []), motion.kind)
            self.shown, self.progress = self.cloud.count, self.progress._replace(motion=None)

    def weigh(
        self, readings: list[SensorReadings], *, judged: Sequence[SensorReadings] = (),
        meanwhile: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Run a postponed motion, correct the particles by readings, and judge scans at the new pose."""
        chosen, drawn = self.options, self.cloud.count
        if chosen.least != chosen.most:
            self.move()
            drawn = kld_count(self.next_particles(), chosen.least, chosen.most)
        copies = False
        if self.progress.moved is None:
            copies = self.progress.copies or self.cloud.summary().resampled
            self.key()
        motion = self.progress.motion or STILL
        settings = self.settings(motion, [index for index, _ in readings])
        self.shown, self.progress = self.cloud.count, Progress(self.progress.step, copies=copies)
        refines = self._moments is not None and not self._moments[2].clear
        self.cloud.correct(settings, motion.kind, chosen.stages, drawn, readings, judged, meanwhile, refines=refines)
        self.wide = max(self.wide - 1, 0)

    def sample_size(self) -> float:
        """Return the effective sample size of the last correction, 1 to the number of shown particles."""
        size, now = self.cloud.summary().effective_sample_size, self.progress
        if now.copies and now.moved is None:
            size = sample_size_of(self.cloud.host_weights(self.shown), self.host_particles())
        elif not size > 0:
            # The kernels lack a sum of squares before a correction, or if no weighted particle was possible.
            size = sample_size_of(self.cloud.host_weights(self.shown))
        return min(max(size, 1.0), float(self.shown))

    def learn(self, readings: list[SensorReadings], is_doubted: Callable[[], bool]) -> None:
        """Determine whether the particles are concentrated, and begin lessons of scans at an uncontradicted pose."""
        self.corrections += 1
        due = []
        if self.options.temperature == "auto":
            scans = [(self.sensors[index], reading) for index, reading in readings]
            due = [one for one in scans if one[0].learner is not None and one[0].learner.count()]
        if not (due or not self.together or self.corrections % _LOOK == 0):
            return
        pose, covariance = self.mean_and_covariance()
        self.together = is_together(covariance)
        if due and self.together and not is_doubted() and self.cloud.summary().effective_sample_size >= 2:
            for sensor, reading in due:
                sensor.begin_lesson(pose, covariance, reading)

    def settings(self, motion: SampledMotion, indices: list[int]) -> np.ndarray:
        """Return the settings of the present step with readings of the sensors ``indices``."""
        temperature, sensors = self.options.temperature, []
        wide = DEFAULTS.wide_share if self.wide and temperature == "auto" else 1.0
        one_peak = self.together
        for index in indices:
            sensor = self.sensors[index]
            sensors.append((sensor.temperature(temperature) * (wide if sensor.calibrates else 1.0), sensor.beams))
            one_peak = one_peak and not sensor.ambiguous
        step, count = self.progress.step, self.cloud.count
        return settings_of_step(self.options, motion, step, count, self.pool, sensors, one_peak)


def is_together(covariance: np.ndarray) -> bool:
    """Return whether the deviations of a (3, 3) covariance along x and y are at most half a metre."""
    return bool(max(covariance[0, 0], covariance[1, 1]) <= WIDE**2)


def kld_count(poses: np.ndarray, least: int, most: int) -> int:
    """Return the particles that bound the Kullback-Leibler distance to the density of (N, 3) poses by ``ERROR``.

    Fox, *KLD-sampling: adaptive particle filters* (2001); *Probabilistic Robotics* table 8.4.
    """
    scaled = np.floor(poses / (BIN, BIN, BIN_TURN)).astype(np.int64)
    scaled -= scaled.min(axis=0)
    spans = scaled.max(axis=0) + 1
    filled = len(np.unique((scaled[:, 0] * spans[1] + scaled[:, 1]) * spans[2] + scaled[:, 2]))
    if filled < 2:
        return least
    k = filled - 1
    part = 2 / (9 * k)
    count = k / (2 * ERROR) * (1 - part + math.sqrt(part) * QUANTILE) ** 3
    return int(min(max(math.ceil(count), least), most))
