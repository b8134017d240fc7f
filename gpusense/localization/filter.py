"""Particle filter: Monte Carlo localisation with the measurement and motion models of this package."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.backends import BackendInfo
from gpusense.interface.constants import (
    DEVIATION,
    FARTHEST_THETA,
    FARTHEST_X,
    FAST_RATE,
    FIRST,
    JITTER,
    MEAN,
    MOST_INJECTED,
    PER_BEAM_SCALE,
    POOL,
    REVERSE,
    SCALE,
    SEED,
    SETTINGS,
    SHARE,
    SLOW_RATE,
    STATE,
    STEP,
    STRATIFIED,
    TEMPERATURE,
    THRESHOLD,
)
from gpusense.interface.launches import Program
from gpusense.localization import skipping, starts
from gpusense.localization.adaptive import kld_count
from gpusense.localization.cloud import Cloud
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.estimates import Estimate, clustered, covariance_of
from gpusense.localization.motion import MotionModel, OdometryMotion, SampledMotion, settings_of
from gpusense.localization.sensors import Sensor
from gpusense.localization.verdict import Verdict
from gpusense.world.grid import OccupancyGrid

_MOST_SENSORS = FIRST - TEMPERATURE
_STILL = SampledMotion((0.0,) * 4, (0.0,) * 4)
_MOST = 1 << 24


class ParticleFilter:
    """Monte Carlo localisation: particles that move with the odometry and are weighed by sensors.

    All state is on the device of the models. Random numbers depend on seed, step and particle alone: the same seed
    gives the same particles on every backend, but for roundings of log-likelihoods. A correction has up to ``stages``
    stages: each takes as much of the temperature as leaves a share of the particles with weight, draws, and lets
    drawn particles differ a little (annealing). So a few hundred particles track a precise scanner.

    Args:
        models: A measurement model, or several of one device: of scans, landmarks, beacons, positions, headings,
            contacts. Each with temperature 1.
        motion: :class:`OdometryMotion`, :class:`OmniMotion` or :class:`VelocityMotion`.
        particles: Their number, or (least, most): as many as KLD sampling asks for (Fox 2001).
        seed: Seed of the random numbers, 0 to 2^64 - 1.
        temperature: Factor of the log-likelihoods of scans in (0, 1], or "auto": from the correlation of beams, which
            the filter measures while it runs (:func:`calibrate_temperature`). Other sensors have temperature 1.
        resampling: "systematic" or "stratified".
        threshold: Resample where the effective sample size is below this share of the particles.
        stages: Most stages of a correction, 1 to 6; 1 is the plain particle filter with tempered weights.
        recovery: None, "augmented": inject uniform particles where the scans' likelihood drops (*Probabilistic
            Robotics* table 8.3), or "sensor": inject them where the scan is likely (sensor resetting, Lenser and
            Veloso 2000) as soon as the filter finds itself lost.
        beam_skip: None, or a share of the particles in (0, 1): a beam that fewer of them explain is left out, such as
            one of a person. A scan of which most beams would be left out is used as a whole, and so is each scan while
            the particles lie apart. Each correction then asks 100 particles on the host first.

    Raises:
        TypeError: A model or option of another type.
        ValueError: No model, models of several devices, a device without float64, or an option beyond its limits.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> model = gs.PositionModel(gs.PositionParameters(sigma=0.1), backend="numpy")
        >>> pf = gs.ParticleFilter(model, particles=500, seed=1)
        >>> pf.initialize(mean=(0.5, 0.0, 0.0), covariance=np.diag([0.04, 0.04, 1e-6]))
        >>> pf.predict((0, 0, 0), (0.5, 0, 0)); pf.correct(np.array([1.0, 0.0]))
        >>> bool(abs(pf.estimate().pose[0] - 1.0) < 0.1)
        True
    """

    def __init__(
        self,
        models: Any,
        *,
        motion: MotionModel | None = None,
        particles: int | tuple[int, int] = DEFAULTS.particles,
        seed: int = 0,
        temperature: float | str = "auto",
        resampling: str = "systematic",
        threshold: float = DEFAULTS.threshold,
        stages: int = DEFAULTS.stages,
        recovery: str | None = None,
        beam_skip: float | None = None,
    ) -> None:
        chosen = list(models) if isinstance(models, Sequence) else [models]
        if not 0 < len(chosen) <= _MOST_SENSORS:
            raise ValueError(f"models: must be 1 to {_MOST_SENSORS} measurement models, got {len(chosen)}")
        self._sensors = [Sensor(model) for model in chosen]
        self._backend = self._sensors[0].backend
        if any(sensor.backend is not self._backend for sensor in self._sensors):
            names = ", ".join(sorted({sensor.backend.info.selection for sensor in self._sensors}))
            raise ValueError(f"models: must be of one device, got {names}")
        if len({sensor.precision for sensor in self._sensors}) > 1:
            raise ValueError("models: must have one precision, got float32 and float64")
        if not self._backend.info.float64:
            raise ValueError(f"models: must be on a device with float64, got {self._backend.info.name}")
        self.motion: MotionModel = OdometryMotion() if motion is None else motion
        if not hasattr(self.motion, "sampled"):
            raise TypeError(f"motion: must be a motion model, got {checks.show(motion)}")
        self._least, self._most = _counts(particles)
        self.seed = checks.integer("seed", seed, low=0, high=(1 << 64) - 1)
        self.temperature = temperature
        if temperature != "auto":
            self.temperature = checks.real("temperature", temperature, above=0, high=1)
        self.resampling = checks.choice("resampling", resampling, ("systematic", "stratified"))
        self.threshold = checks.real("threshold", threshold, above=0, high=1)
        self.stages = checks.integer("stages", stages, low=1, high=6)
        self.recovery = None if recovery is None else checks.choice("recovery", recovery, ("augmented", "sensor"))
        self.beam_skip = None if beam_skip is None else checks.real("beam_skip", beam_skip, above=0, below=1)
        self._cloud = Cloud(self._backend, self._most, len(self._sensors), self._sensors[0].precision)
        self._step, self._started, self._pending = 0, False, _STILL
        self._shown, self._wide = self._most, 0
        self._pool_size, self._spread = 0, (0.0, 0.0, 0.0)
        self._verdict = Verdict(self._sensors, self._random_poses, seed=self.seed)
        self._last: dict[int, tuple[Any, ...]] = {}

    def __repr__(self) -> str:
        count = f"{self._least}" if self._least == self._most else f"({self._least}, {self._most})"
        sensors = ", ".join(type(sensor.model).__name__ for sensor in self._sensors)
        return (
            f"ParticleFilter([{sensors}], {self.motion!r}, particles={count}, temperature={self.temperature!r}, "
            f"stages={self.stages}, backend={self.device.selection!r})"
        )

    @property
    def device(self) -> BackendInfo:
        """The device of all state."""
        return self._backend.info

    @property
    def count(self) -> int:
        """Number of particles of the next step."""
        return self._cloud.count

    # ---- beginnings

    def initialize(self, *, mean: AnyArray, covariance: AnyArray, particles: int | None = None) -> None:
        """Draw particles from a normal density.

        Args:
            mean: (3,) pose [m, m, rad].
            covariance: (3, 3) covariance, positive semidefinite.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: an argument breaks its rule.
        """
        self._place(starts.normal(mean, covariance, self._number(particles), self._key()))

    def initialize_uniform(self, *, bounds: AnyArray | None = None, particles: int | None = None) -> None:
        """Draw particles uniformly over the free cells of the map, with any heading.

        Args:
            bounds: ((x_min, y_min), (x_max, y_max)) [m]: only there. Needed for models without a grid.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: an argument breaks its rule, or no cell is free.
        """
        pool, spread = starts.free_pool([sensor.model for sensor in self._sensors], bounds)
        self._place(starts.spread(pool, spread, self._number(particles), self._key()))
        self._wide = DEFAULTS.wide_scans

    def initialize_from(self, likelihood: Any, *, particles: int | None = None) -> None:
        """Draw particles from a likelihood over poses.

        Args:
            likelihood: An object with ``log_p``, an array of M log-likelihoods of any shape, and ``positions``, (M, 3)
                poses in the same order or an array of shape ``log_p.shape + (3,)``.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: it has not these, or no finite log-likelihood.
        """
        pool, spread = starts.likely_pool(likelihood, self._number(particles), self._key())
        self._place(starts.spread(pool, spread, self._number(particles), self._key(), each=True))

    def _number(self, particles: int | None) -> int:
        return self._most if particles is None else checks.integer("particles", particles, low=1, high=self._most)

    def _place(self, poses: np.ndarray) -> None:
        """Replace all particles, and forget what was learned about the likelihood of scans."""
        self._cloud.place(poses)
        self._shown, self._started, self._pending, self._wide = len(poses), True, _STILL, 0
        self._backend.upload(np.zeros(STATE), self._cloud.state)
        self._verdict.reset()
        if self.recovery == "augmented" and not self._pool_size:
            self._set_pool(*starts.free_pool([sensor.model for sensor in self._sensors], None))

    def _set_pool(self, pool: np.ndarray, spread: tuple[float, float, float]) -> None:
        self._cloud.set_pool(pool)
        self._pool_size, self._spread = len(pool), spread

    def _key(self) -> tuple[int, int, int]:
        """Return the two words of the seed, and a number of this step."""
        self._step += 1
        return self.seed & 0xFFFFFFFF, self.seed >> 32, self._step

    def _random_poses(self, count: int) -> np.ndarray:
        """Return poses anywhere in the free space, the same ones each time; around the particles without a grid."""
        key = (self.seed & 0xFFFFFFFF, self.seed >> 32, 0)
        try:
            pool, spread = starts.free_pool([sensor.model for sensor in self._sensors], None)
        except ValueError:
            centre = self._cloud.host_poses(self._cloud.shown, self._shown).mean(axis=0)
            pool, spread = centre[None], (10.0, 10.0, math.pi)
        return starts.spread(pool, spread, count, key)

    # ---- steps

    def predict(self, *motion: Any) -> None:
        """Move the particles: by the odometry before and after the step, or what the motion model takes.

        Args:
            *motion: Of odometry, (3,) and (3,) poses in the frame of the odometer; of velocities, (v, w) and seconds.

        Raises:
            RuntimeError: the filter is not initialised.
            TypeError, ValueError: an argument breaks its rule.
        """
        self._check_started()
        sampled = self.motion.sampled(*motion)
        if self._pending is not _STILL:
            self.flush()
        # The next correction begins with the move: one program has both.
        self._pending = sampled

    def correct(self, readings: Any) -> None:
        """Weigh the particles by readings, and draw new ones where it is due.

        Args:
            readings: The reading of the filter's only model, or a mapping from models to their readings; those of a
                model whose ``log_likelihood`` takes several arguments are a tuple. None is a missing reading.

        Raises:
            RuntimeError: the filter is not initialised.
            KeyError: a model that is not the filter's.
            TypeError, ValueError: readings that the model refuses.
        """
        self._check_started()
        given = self._given(readings)
        if not given:
            return
        if self._verdict.watches(dict(given)):
            self._verdict.predicted(self.host_particles(), self.host_weights(), dict(given))
        whole = dict(given)
        if self.beam_skip is not None:
            given = self._without_skipped(given, self.beam_skip)
        motion, self._pending = self._pending, _STILL
        drawn = self._cloud.count if self._least == self._most else self._wanted()
        settings = self._settings(motion, [index for index, _ in given])
        self._cloud.upload_settings(settings)
        drawn = self._score(given, motion.kind, drawn)
        self._shown = self._cloud.count
        self._cloud.resized(drawn)
        self._last = whole
        self._wide = max(self._wide - 1, 0)
        self._verdict.corrected()
        if self.temperature == "auto":
            self._calibrate(given)
        if self.recovery == "sensor" and self._verdict.due and self.estimate().lost:
            self.reset()

    def reset(self) -> None:
        """Replace half of the particles by poses at which the last readings are likely (sensor resetting).

        Raises:
            RuntimeError: there are no readings yet.
        """
        if not self._last:
            raise RuntimeError("reset: needs a correction first")
        count = max(self._cloud.count // 2, 1)
        tries = self._random_poses(max(20_000, 10 * count))
        score = np.zeros(len(tries))
        for index, reading in self._last.items():
            sensor = self._sensors[index]
            score += sensor.temperature(self.temperature, reading) * sensor.log_likelihood(tries, reading)
        with np.errstate(invalid="ignore"):
            best = np.argsort(-score, kind="stable")[: max(count // 10, 1)]
        chosen = starts.spread(tries[best], (0.1, 0.1, 0.05), count, self._key(), each=True)
        kept = self._cloud.host_poses(self._cloud.next, self._cloud.count)
        kept[:: max(len(kept) // count, 1)][:count] = chosen[: len(kept[:: max(len(kept) // count, 1)][:count])]
        self._place(kept)

    def flush(self) -> None:
        """Run the motion of the last ``predict`` now, as a step of its own; the next correction does it otherwise."""
        if self._pending is _STILL:
            return
        motion, self._pending = self._pending, _STILL
        self._cloud.upload_settings(self._settings(motion, []))
        self._cloud.move(motion.kind)
        self._shown = self._cloud.count

    def _score(self, given: list[tuple[int, tuple[Any, ...]]], kind: int, drawn: int) -> int:
        """Run the stages of a correction; return the number of particles drawn."""
        cloud = self._cloud
        recorded = self._backend.info.kind == "gpu" and all(self._sensors[i].records(reading) for i, reading in given)
        if recorded:
            for index, reading in given:
                self._sensors[index].upload(reading)
            key = (tuple((i, self._sensors[i].version) for i, _ in given), cloud.count)
            cloud.replay(kind, self.stages, drawn, key, lambda source: self._programs(source, given))
            return drawn

        def score(source: int) -> None:
            if self._backend.info.kind == "gpu":
                poses: Any = cloud.lent(cloud.poses[source], (cloud.count, 3))
                for place, (index, reading) in enumerate(given):
                    self._sensors[index].log_likelihood(poses, reading, self._log_p(place))
                return
            poses = cloud.host_poses(source, cloud.count)
            for place, (index, reading) in enumerate(given):
                log_p = self._sensors[index].log_likelihood(poses, reading)
                self._backend.upload(log_p, cloud.log_p[place])

        return cloud.correct(kind, self.stages, drawn, len(given), score)

    def _without_skipped(self, given: list[tuple[int, tuple[Any, ...]]], share: float) -> list[tuple[int, Any]]:
        """Return readings without the beams that too few particles explain."""
        poses, weights = self.host_particles(), self.host_weights()
        if not skipping.together(poses, weights):
            return given
        asked = slice(None, None, max(len(poses) // skipping.ASKED, 1))
        few, anywhere = (poses[asked], weights[asked]), self._verdict.anywhere()
        return [
            (i, skipping.without_skipped(self._sensors[i], reading, *few, anywhere, share))
            if self._sensors[i].calibrates
            else (i, reading)
            for i, reading in given
        ]

    def _programs(self, source: int, given: list[tuple[int, tuple[Any, ...]]]) -> tuple[Any, object]:
        """Return the launches that score the poses of a buffer, and the owners of their memory."""
        cloud = self._cloud
        program: Program = ()
        owners: list[object] = []
        cloud.use(len(given))
        poses = cloud.lent(cloud.poses[source], (cloud.count, 3))
        for place, (index, _) in enumerate(given):
            out = self._log_p(place)
            launches, owner = self._sensors[index].program(poses, out)
            program += launches
            owners.append((poses, out, owner))
        return program, owners

    def _log_p(self, place: int) -> Any:
        """Return the array for a sensor's log-likelihoods as one of the device's library."""
        cloud = self._cloud
        part = self._backend.part(cloud.log_p[place], 0, cloud.count, cloud.precision)
        return self._backend.lend(part, (cloud.count,), cloud.precision)

    def _given(self, readings: Any) -> list[tuple[int, tuple[Any, ...]]]:
        """Return (index of a sensor, its readings) of those that are not missing, in the order of the sensors."""
        if isinstance(readings, Mapping):
            index = {id(sensor.model): i for i, sensor in enumerate(self._sensors)}
            for model in readings:
                if id(model) not in index:
                    raise KeyError(f"readings: must be of the filter's models, got those of {checks.show(model)}")
            pairs = sorted((index[id(model)], value) for model, value in readings.items() if value is not None)
        elif len(self._sensors) > 1:
            raise TypeError(f"readings: must be a mapping from models to their readings, got {checks.show(readings)}")
        else:
            pairs = [] if readings is None else [(0, readings)]
        given = [(i, value if isinstance(value, tuple) else (value,)) for i, value in pairs]
        return given

    def _settings(self, motion: SampledMotion, given: list[int]) -> np.ndarray:
        """Return the numbers of a step."""
        s, count = np.zeros(SETTINGS), self._cloud.count
        s[SEED], s[SEED + 1], s[STEP] = self._key()
        s[MEAN : DEVIATION + 4], s[REVERSE] = settings_of(motion)
        s[JITTER], s[FARTHEST_X], s[FARTHEST_THETA] = DEFAULTS.jitter, DEFAULTS.farthest, DEFAULTS.farthest_turn
        s[POOL], s[POOL + 1 : POOL + 4] = self._pool_size, self._spread
        s[SHARE], s[THRESHOLD] = DEFAULTS.share, self.threshold
        s[STRATIFIED] = float(self.resampling == "stratified")
        # Sums of weights stay below 2^53: a weight is 1 on average, and their squares at most 1 / threshold.
        spare = math.ceil(math.log2(max(count, 2))) + math.ceil(-math.log2(self.threshold)) + 2
        s[SCALE] = 2.0 ** (52 - spare)
        if self.recovery == "augmented":
            s[SLOW_RATE], s[FAST_RATE] = DEFAULTS.slow, DEFAULTS.fast
            s[MOST_INJECTED] = DEFAULTS.most_injected
        total, wide = 0.0, DEFAULTS.wide_share if self._wide and self.temperature == "auto" else 1.0
        for place, index in enumerate(given):
            sensor = self._sensors[index]
            s[TEMPERATURE + place] = sensor.temperature(self.temperature) * (wide if sensor.calibrates else 1.0)
            total += s[TEMPERATURE + place] * max(sensor.beams, 1)
        s[PER_BEAM_SCALE] = 1 / total if total > 0 else 0.0
        return s

    def _calibrate(self, given: list[tuple[int, tuple[Any, ...]]]) -> None:
        """Learn the correlation of beams at the estimate, often at first and seldom later."""
        due = [(i, reading) for i, reading in given if self._sensors[i].calibrates]
        count = self._verdict.corrections
        if not due or (count > DEFAULTS.calibrations and count % 10 > 1):
            return
        if self._cloud.summary().effective_sample_size < 2:
            return
        pose = self._cloud.estimate(self._shown)[:3]
        for index, reading in due:
            follows = count <= DEFAULTS.calibrations or count % 10 == 1
            self._sensors[index].correlate(pose, reading, follows=follows)

    def _wanted(self) -> int:
        """Return the particles of the next step by KLD sampling."""
        poses = self._cloud.host_poses(self._cloud.next, self._cloud.count)
        return kld_count(poses, self._least, self._most)

    def _check_started(self) -> None:
        if not self._started:
            raise RuntimeError("ParticleFilter: must be initialised first, by initialize or initialize_uniform")

    # ---- results

    def estimate(self, method: str = "mean") -> Estimate:
        """Return the pose of the robot.

        Args:
            method: "mean", the weighted mean with the circular mean of headings; "cluster", the mean of the heaviest
                cluster of particles; "best", the heaviest particle.

        Raises:
            RuntimeError: the filter is not initialised.
            ValueError: another method.
        """
        self._check_started()
        checks.choice("method", method, ("mean", "cluster", "best"))
        self.flush()
        numbers, summary = self._cloud.estimate(self._shown), self._cloud.summary()
        pose, covariance = numbers[:3].copy(), covariance_of(numbers)
        if method != "mean":
            poses = self._cloud.host_poses(self._cloud.shown, self._shown)
            if method == "best":
                pose = poses[int(numbers[10])]
            else:
                pose, covariance = clustered(poses, self._cloud.host_weights(self._shown))
        explained = self._verdict.explained(pose, self._last) if self._last else math.nan
        size = summary.effective_sample_size if self._last else float(self._shown)
        return Estimate(
            pose, covariance, size, self._verdict.lost, explained, self.temperatures[0], summary.temperature,
            summary.degenerate, self._shown,
        )  # fmt: skip

    def mean_and_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted mean (3,) and the covariance (3, 3), without the verdict of :meth:`estimate`."""
        self._check_started()
        self.flush()
        numbers = self._cloud.estimate(self._shown)
        return numbers[:3].copy(), covariance_of(numbers)

    @property
    def temperatures(self) -> tuple[float, ...]:
        """Temperature of each model now."""
        return tuple(sensor.temperature(self.temperature) for sensor in self._sensors)

    @property
    def gain(self) -> float:
        """Mean gain of recent features over features anywhere or false ones [nats]; below 1 the filter is lost.

        NaN without a landmark model, and before 20 scans with features.
        """
        return self._verdict.gain

    @property
    def scoring_seconds(self) -> float:
        """Seconds that the models' log-likelihoods have taken; 0 where a step is one recorded program."""
        return sum(sensor.seconds for sensor in self._sensors)

    @property
    def grid(self) -> OccupancyGrid:
        """The map of the first model that has one.

        Raises:
            ValueError: none has one.
        """
        for sensor in self._sensors:
            if hasattr(sensor.model, "grid"):
                return sensor.model.grid
        raise ValueError("models: must have a map, got none with one")

    def host_particles(self) -> np.ndarray:
        """Return a copy of the (N, 3) poses after the last step in host memory."""
        self._check_started()
        self.flush()
        return self._cloud.host_poses(self._cloud.shown, self._shown)

    def host_weights(self) -> np.ndarray:
        """Return a copy of the (N,) weights of the particles in host memory; their sum is 1."""
        self._check_started()
        self.flush()
        weights = self._cloud.host_weights(self._shown)
        return weights / weights.sum()

    @property
    def particles(self) -> Any:
        """(N, 3) poses after the last step: on a GPU an array of the device, which other libraries use in place."""
        self._check_started()
        self.flush()
        return self._array(self._cloud.poses[self._cloud.shown], (self._shown, 3))

    @property
    def weights(self) -> Any:
        """(N,) weights of the particles, whose sum is 1: on a GPU an array of the device."""
        weights = self.host_weights()
        if self._backend.info.kind != "gpu":
            return weights
        buffer = self._backend.blank(self._shown, weights.dtype)
        return self._backend.lend(self._backend.upload(weights, buffer), weights.shape, weights.dtype)

    def _array(self, buffer: Any, shape: tuple[int, ...]) -> Any:
        if self._backend.info.kind == "gpu":
            return self._cloud.lent(buffer, shape)
        return self._backend.download(buffer, np.empty(shape))

    def explain(self) -> str:
        """Return in one line how a step is started on the device."""
        return self._cloud.explain()


def _counts(particles: Any) -> tuple[int, int]:
    """Return the least and the largest number of particles."""
    pair = particles if isinstance(particles, (tuple, list)) else (particles, particles)
    if len(pair) != 2:
        raise ValueError(f"particles: must be a number or (least, most), got {checks.show(particles)}")
    least, most = (checks.integer("particles", value, low=1, high=_MOST) for value in pair)
    if least > most:
        raise ValueError(f"particles: least must be at most the largest, got {checks.show(particles)}")
    return least, most
