"""Particle filter for Monte Carlo localisation."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.backends import BackendInfo
from gpusense.localization.cloud import Cloud
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.diagnosis import Diagnosis, diagnose
from gpusense.localization.estimates import Estimate
from gpusense.localization.filter_core import FilterCore
from gpusense.localization.journal import Transactional, atomic, consistent
from gpusense.localization.motion import MotionModel, OdometryMotion, SampledMotion
from gpusense.localization.sensors import grid_of, sensors_of
from gpusense.localization.state import FilterState, check_state, checked_options, constructor_options, model_names
from gpusense.localization.tracker import Tracker
from gpusense.world.grid import OccupancyGrid


class ParticleFilter(Transactional):
    """Monte Carlo localisation: particles move with the odometry, and sensors weigh them.

    All state is on the device of the models. Random numbers depend only on seed, step and particle: a seed yields the
    same particles on every backend, up to rounding of log-likelihoods. A correction has up to ``stages`` stages. Each
    applies the largest share of the temperature that keeps the effective sample size above a threshold, then resamples
    and jitters (annealing). A few hundred particles therefore suffice for a precise scanner.

    Args:
        models: A measurement model, or several models on one device: scans, landmarks, beacons, positions, headings,
            contacts; each of temperature 1.
        motion: :class:`OdometryMotion`, :class:`OmniMotion` or :class:`VelocityMotion`.
        particles: Number of particles, or (least, most) for KLD sampling (Fox 2001).
        seed: Seed of the random numbers, 0 to 2^64 - 1.
        temperature: Factor of the log-likelihoods of scans in (0, 1], or "auto" for the measured correlation of beams
            (:func:`calibrate_temperature`). Other sensors have temperature 1.
        resampling: "systematic", "stratified" or "residual", all with exact sums.
        threshold: Resample where the effective sample size is below this share of the particles.
        stages: Most stages of a correction, 1 to 6; 1 is the plain particle filter with tempered weights.
        recovery: "sensor": if scans contradict the pose, a rival cloud starts where the scan is likely (sensor
            resetting, Lenser and Veloso 2000), and takes over once later scans prefer it; "augmented": inject uniform
            particles when the scans' likelihood drops (*Probabilistic Robotics* table 8.3); None: neither.
        beam_skip: None, or a share of the particles in (0, 1): beams explained by a smaller share, such as beams on
            people, are skipped. A scan that would lose most of its beams is used completely, as are all scans while the
            particles are spread out. Each correction then evaluates 100 particles on the host first.

    Attributes:
        motion: The motion model.
        options: The options, checked.

    Raises:
        TypeError: A model or option has the wrong type.
        ValueError: There is no model, models have several devices, a device lacks float64, an option breaks its rule,
            or ``recovery="augmented"`` has no map.

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
        recovery: str | None = DEFAULTS.recovery,
        beam_skip: float | None = None,
    ) -> None:
        self._sensors = sensors_of(models)
        self._backend = self._sensors[0].backend
        self.motion: MotionModel = OdometryMotion() if motion is None else motion
        if not hasattr(self.motion, "sampled"):
            raise TypeError(f"motion: must be a motion model, got {checks.show(motion)}")
        self.options = checked_options(
            particles=particles, seed=seed, temperature=temperature, resampling=resampling, threshold=threshold,
            stages=stages, recovery=recovery, beam_skip=beam_skip,
        )  # fmt: skip
        if self.options.recovery == "augmented" and grid_of(self._sensors) is None:
            raise ValueError("recovery: 'augmented' needs a model with a map, got none")
        self._begin_journals()
        self._cloud = Cloud(self._sensors, self.options.most, residual=self.options.resampling == "residual")
        self._parts = FilterCore(self._sensors, self.options, self._cloud)

    def _changing(self) -> tuple[Any, ...]:
        return self._parts.changing()

    def __repr__(self) -> str:
        one = self.options
        count = f"{one.least}" if one.least == one.most else f"({one.least}, {one.most})"
        sensors = ", ".join(type(sensor.model).__name__ for sensor in self._sensors)
        return (
            f"ParticleFilter([{sensors}], {self.motion!r}, particles={count}, temperature={one.temperature!r}, "
            f"stages={one.stages}, backend={self.device.selection!r})"
        )

    def _moved(self) -> Tracker:
        """Return the particles after the motion of the last ``predict``."""
        tracker = self._parts.tracker
        tracker.check_started()
        if tracker.progress.motion is not None:
            self._move()
        return tracker

    # ---- starts

    @atomic
    def initialize(self, *, mean: AnyArray, covariance: AnyArray, particles: int | None = None) -> None:
        """Draw particles from a normal density.

        Args:
            mean: (3,) pose [m, m, rad].
            covariance: (3, 3) covariance, positive semidefinite.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: an argument breaks its rule.

        Warns:
            PlausibilityWarning: the mean is off the map, or its heading exceeds a turn.
        """
        self._parts.start_around(mean, covariance, particles)

    @atomic
    def initialize_uniform(self, *, bounds: AnyArray | None = None, particles: int | None = None) -> None:
        """Draw particles uniformly over the free cells of the map, with any heading.

        Unless bounded, ``recovery="sensor"`` compares the pose after convergence with other places.

        Args:
            bounds: Limits ((x_min, y_min), (x_max, y_max)) [m]; required for models without a grid.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: an argument breaks its rule, or no cell is free.
        """
        self._parts.start_anywhere(bounds, particles)

    @atomic
    def initialize_from(self, likelihood: Any, *, particles: int | None = None) -> None:
        """Draw particles from a likelihood over poses.

        Args:
            likelihood: The result of :func:`pose_likelihood`, or an object with ``log_p`` (M log-likelihoods, an array
                of any shape) and ``positions`` ((M, 3) poses in the same order). Attributes ``resolution`` [m] and
                ``headings``, if present, spread particles over cells and gaps.
            particles: Their number; the filter's (most) by default.

        Raises:
            TypeError, ValueError: ``likelihood`` lacks these arrays, or has no finite log-likelihood.

        Example:
            >>> import gpusense as gs
            >>> grid, scanner = gs.OccupancyGrid([[0, 0, 100]], 1.0), gs.Scanner([0.0], 9.0)
            >>> model = gs.LikelihoodFieldModel(grid, scanner, backend="numpy")
            >>> pf = gs.ParticleFilter(model, particles=100)
            >>> pf.initialize_from(gs.pose_likelihood(model, [1.9], resolution=1.0, headings=4))
            >>> pf.host_particles().shape
            (100, 3)
        """
        self._parts.start_from(likelihood, particles)

    # ---- steps

    @consistent
    def predict(self, *motion: Any) -> None:
        """Move the particles by the odometry before and after the step, or by other arguments of the motion model.

        Args:
            *motion: For odometry two (3,) poses in the odometer's frame; for velocities (v, w) and a duration [s].

        Raises:
            RuntimeError: the filter is not initialised.
            TypeError, ValueError: an argument breaks its rule.
        """
        tracker, rival = self._parts.tracker, self._parts.recovery.rival
        tracker.check_started()
        sampled = self.motion.sampled(*motion)
        if tracker.progress.motion is None and rival is None:
            # A single assignment, indivisible by interrupts.
            tracker.follow(sampled)
        else:
            self._follow(sampled)

    @atomic
    def _follow(self, motion: SampledMotion) -> None:
        self._parts.follow(motion)

    @consistent
    def flush(self) -> None:
        """Run the motion of the last ``predict`` now instead of at the next correction or result."""
        if self._parts.tracker.progress.motion is not None:
            self._move()

    @atomic
    def _move(self) -> None:
        self._parts.tracker.move()

    @atomic
    def correct(self, readings: Any) -> None:
        """Weigh the particles by readings, and resample where the effective sample size is low.

        Args:
            readings: The reading of the filter's only model, or a mapping from models to their readings. If
                ``log_likelihood`` takes several arguments, pass a tuple of them: ``(features, correspondence)``,
                ``(ranges, ids)``, ``(fix, covariance)``. None is a missing reading. Arrays on a device must not change
                until :meth:`diagnose`, :meth:`reset` and :meth:`state`, which read them again.

        An exception, even a user's interrupt, leaves the filter unchanged, so that the correction can be repeated.
        This holds for all calls of a filter.

        Raises:
            RuntimeError: the filter is not initialised.
            KeyError: a model that is not the filter's.
            TypeError, ValueError: readings that the model refuses.
        """
        self._parts.correct(readings)

    @atomic
    def reset(self) -> None:
        """Replace half of the particles by poses that make the last readings likely (sensor resetting).

        A motion predicted after these readings also moves the new particles.

        Raises:
            RuntimeError: there are no readings since the particles were initialised.
        """
        if not self._parts.last:
            raise RuntimeError("reset: needs a correction first")
        self._parts.reset()

    # ---- results

    @property
    def device(self) -> BackendInfo:
        """The device of all state."""
        return self._backend.info

    @property
    @consistent
    def count(self) -> int:
        """Number of particles of the next step."""
        return self._cloud.count

    @consistent
    def estimate(self, method: str = "mean") -> Estimate:
        """Return the pose of the robot without changing the filter: corrections judge the pose.

        Args:
            method: "mean", the weighted mean with the circular mean of headings; "cluster", the mean of the heaviest
                cluster of particles; "best", the heaviest particle.

        Raises:
            RuntimeError: the filter is not initialised.
            ValueError: another method.
        """
        if type(method) is not str or method != "mean":
            checks.choice("method", method, ("mean", "cluster", "best"))
        self._moved()
        return self._parts.estimate(method)

    @consistent
    def diagnose(self, *, search: bool = True) -> Diagnosis:
        """Return the evidence of the last readings at the estimate, and the likely cause of a contradiction.

        Args:
            search: Whether to search for a better pose elsewhere on the map, which takes a few milliseconds.

        Raises:
            RuntimeError: the filter is not initialised.
        """
        checks.boolean("search", search)
        pose, _ = self.mean_and_covariance()
        search = search and grid_of(self._sensors) is not None
        return diagnose(self._sensors, self._parts.last, pose, self._parts.tracker.random_poses if search else None)

    @consistent
    def mean_and_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted mean (3,) and the covariance (3, 3), without the verdict of :meth:`estimate`."""
        mean, covariance = self._moved().mean_and_covariance()
        return mean.copy(), covariance.copy()

    @property
    def models(self) -> tuple[Any, ...]:
        """The measurement models, in the order of ``temperatures``."""
        return tuple(sensor.model for sensor in self._sensors)

    @property
    @consistent
    def temperatures(self) -> tuple[float, ...]:
        """Present temperature of each model."""
        return tuple(sensor.temperature(self.options.temperature) for sensor in self._sensors)

    @property
    def grid(self) -> OccupancyGrid:
        """The map of the first model that has one.

        Raises:
            ValueError: none has one.
        """
        grid = grid_of(self._sensors)
        if grid is None:
            raise ValueError("models: must have a map, got none with one")
        return grid

    @consistent
    def host_particles(self) -> np.ndarray:
        """Return a copy of the (N, 3) poses after the last step in host memory."""
        return self._moved().host_particles()

    @consistent
    def host_weights(self) -> np.ndarray:
        """Return a copy of the (N,) normalised weights in host memory."""
        return self._moved().host_weights()

    @property
    @consistent
    def particles(self) -> Any:
        """(N, 3) poses after the last step: on a GPU an array of the device, for use in place by other libraries."""
        return self._cloud.particles(self._moved().shown)

    @property
    @consistent
    def weights(self) -> Any:
        """(N,) normalised weights: on a GPU an array of the device."""
        return self._cloud.shares(self._moved().shown)

    @property
    @consistent
    def moments(self) -> Any:
        """(9,) mean x, y, theta and covariance xx, xy, xt, yy, yt, tt: on a GPU an array of the device."""
        return self._cloud.moments(self._moved().shown)

    def explain(self) -> str:
        """Describe in one line how a step starts on the device."""
        return self._cloud.explain()

    # ---- state

    @consistent
    def state(self) -> FilterState:
        """Return a copy of the filter's state without models and device, see :class:`FilterState`."""
        self.flush()
        return FilterState(*self._kind(), *self._parts.state())

    @atomic
    def restore(self, state: FilterState) -> None:
        """Restore the state of a filter with the same options and models, and continue with the same bits.

        Args:
            state: The result of :meth:`state`, possibly from another device.

        Raises:
            TypeError, ValueError: ``state`` is no state, or belongs to a filter with other options or models.
        """
        checked = check_state(state, *self._kind())
        self._parts.restore(checked.contents, checked.memory)

    def _kind(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Return the constructor's options, and the names of the models' classes."""
        return constructor_options(self.options, self.motion), model_names(self._sensors)

    def __getstate__(self) -> dict[str, Any]:
        return {"models": self.models, "state": self.state()}

    def __setstate__(self, values: dict[str, Any]) -> None:
        ParticleFilter.__init__(self, values["models"], **values["state"].options)
        self.restore(values["state"])
