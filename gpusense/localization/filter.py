"""Particle filter: Monte Carlo localisation with the measurement and motion models of this package."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.localization import options, resetting, skipping, starts
from gpusense.localization.adaptive import kld_count
from gpusense.localization.beginnings import Beginnings
from gpusense.localization.calibration import LOOK, due_of, is_together
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.device_cloud import DeviceCloud
from gpusense.localization.estimates import covariance_of
from gpusense.localization.filter_cloud import FilterCloud, Given, Step
from gpusense.localization.journal import plain_state, set_state, settled, whole
from gpusense.localization.motion import STILL, MotionModel, OdometryMotion, SampledMotion
from gpusense.localization.rival import COMPARISONS, PARTICLES, PRIOR, Rival, evidence_of
from gpusense.localization.rival_search import can_search
from gpusense.localization.scoring import given_of
from gpusense.localization.sensors import sensors_of
from gpusense.localization.state import FilterState, check_state, constructor_options, model_names, readings_on_host
from gpusense.localization.verdict import Verdict

# Makes the seed of a rival from that of its filter.
_RIVAL = 0x9E3779B97F4A7C15
# Probability that another place is right above which a rival is searched for; more than before the first scan.
_DOUBT = 0.2


class ParticleFilter(Beginnings):
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
        resampling: "systematic", "stratified" or "residual"; sums are exact in each.
        threshold: Resample where the effective sample size is below this share of the particles.
        stages: Most stages of a correction, 1 to 6; 1 is the plain particle filter with tempered weights.
        recovery: "sensor": where scans contradict the pose, a rival cloud begins where the scan is likely (sensor
            resetting, Lenser and Veloso 2000) and takes over once later scans prefer it; "augmented": inject uniform
            particles where the scans' likelihood drops (*Probabilistic Robotics* table 8.3); None: neither.
        beam_skip: None, or a share of the particles in (0, 1): a beam that fewer of them explain is left out, such as
            one of a person. A scan of which most beams would be left out is used as a whole, and so is each scan while
            the particles lie apart. Each correction then asks 100 particles on the host first.

    Attributes:
        motion: The motion model.
        options: The options, checked.

    Raises:
        TypeError: A model or option of another type.
        ValueError: No model, models of several devices, a device without float64, an option beyond its limits, or
            ``recovery="augmented"`` without a map.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> model = gs.PositionModel(gs.PositionParameters(sigma=0.1), backend="numpy")
        >>> pf = gs.ParticleFilter(model, particles=500, seed=1)
        >>> pf.initialize(mean=(0.5, 0.0, 0.0), covariance=np.diag([0.04, 0.04, 1e-6]))
        >>> pf.predict((0, 0, 0), (0.5, 0, 0)); pf.correct(np.array([1.0, 0.0]))
        >>> bool(abs(pf.estimate().pose[0] - 1.0) < 0.1)
        True
    """

    MEMORY = (
        "_step", "_started", "_pending", "_shown", "_wide", "_corrections", "_together", "_pool", "_last", "_rival",
        "_everywhere", "_distinct",
        "_verdict", "_sensors", "_cloud",
    )  # fmt: skip
    PARTS = ()

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
        self.options = options.checked(
            particles=particles, seed=seed, temperature=temperature, resampling=resampling, threshold=threshold,
            stages=stages, recovery=recovery, beam_skip=beam_skip,
        )  # fmt: skip
        if self.options.recovery == "augmented" and not any(hasattr(one.model, "grid") for one in self._sensors):
            raise ValueError("recovery: 'augmented' needs a model with a map, got none")
        self._begin_journals()
        self._cloud = self._new_cloud()
        self._step, self._started, self._pending = 0, False, None
        self._shown, self._wide = self.options.most, 0
        self._corrections, self._together = 0, False
        self._pool = 0, (0.0, 0.0, 0.0)
        self._verdict = Verdict(self._sensors, self._random_poses, seed=self.options.seed)
        self._last: dict[int, tuple[Any, ...]] = {}
        self._rival: Rival | None = None
        self._distinct = 1.0
        self._everywhere = 0

    def _new_cloud(self) -> FilterCloud:
        """Return room for the particles."""
        return DeviceCloud(self._sensors, self.options.most, residual=self.options.resampling == "residual")

    def _keep(self) -> None:
        self._cloud.kept = self._cloud.places
        if self._rival is not None:
            self._rival.keep()

    def _changing(self, method: str) -> tuple[Any, ...]:
        if method == "estimate" and self._pending is None:
            # It runs the pending motion, and judges the pose.
            return (self._verdict,)
        rival = () if self._rival is None else self._rival.changing()
        return self, self._cloud, self._verdict, *self._sensors, *rival

    def __repr__(self) -> str:
        one = self.options
        count = f"{one.least}" if one.least == one.most else f"({one.least}, {one.most})"
        sensors = ", ".join(type(sensor.model).__name__ for sensor in self._sensors)
        return (
            f"ParticleFilter([{sensors}], {self.motion!r}, particles={count}, temperature={one.temperature!r}, "
            f"stages={one.stages}, backend={self.device.selection!r})"
        )

    @settled
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
        if self._rival is None or not self._rival.active:
            self._follow(sampled)
        else:
            self._follow_both(sampled)

    def _follow(self, motion: SampledMotion) -> None:
        """Move the particles when the next correction begins: one program has both."""
        if self._pending is None:
            self._pending = motion
        else:
            self._move(motion)

    @whole
    def _follow_both(self, motion: SampledMotion) -> None:
        """Move the particles and their rival."""
        self._follow(motion)
        if self._rival is not None:
            self._rival.predict(motion)

    @whole
    def correct(self, readings: Any) -> None:
        """Weigh the particles by readings, and draw new ones where it is due.

        Args:
            readings: The reading of the filter's only model, or a mapping from models to their readings. Where
                ``log_likelihood`` takes several arguments, a tuple has them: ``(features, correspondence)``,
                ``(ranges, ids)``, ``(fix, covariance)``. None is a missing reading.
                :meth:`estimate` and :meth:`reset` read arrays of a device again, which must not change until then.

        Where it raises, an interrupt by the user included, the filter is as it was before, so a correction can be
        repeated. So are all calls of a filter.

        Raises:
            RuntimeError: the filter is not initialised.
            KeyError: a model that is not the filter's.
            TypeError, ValueError: readings that the model refuses.
        """
        self._check_started()
        given = given_of(readings, self._sensors)
        if not given:
            return
        chosen, whole = self.options, dict(given)
        if self._verdict.watches(whole):
            self._verdict.predicted(self.host_particles(), self.host_weights(), whole)
        if chosen.beam_skip is not None:
            particles = self.host_particles(), self.host_weights()
            given = skipping.skipped(self._sensors, given, particles, self._verdict.anywhere, chosen.beam_skip)
        self._weigh(given)
        # The caller may write the next readings to the same arrays.
        self._last = {index: tuple(map(_copied, reading)) for index, reading in whole.items()}
        self._verdict.corrected()
        self._corrections += 1
        self._learn(given)
        self._recover(given)

    def _weigh(self, given: list[Given]) -> None:
        """Run the motion, and correct the particles by readings of sensors."""
        chosen, motion = self.options, STILL if self._pending is None else self._pending
        self._distinct = self._distinct_share() if self._pending is None and self._last else 1.0
        drawn = self._cloud.count if chosen.least == chosen.most else self._wanted()
        settings = self._settings(motion, [index for index, _ in given])
        self._shown, self._pending = self._cloud.count, None
        self._cloud.correct(Step(settings, motion.kind, chosen.stages, drawn, given))
        self._wide = max(self._wide - 1, 0)

    def _distinct_share(self) -> float:
        """Return the share of distinct particles before a correction without motion, where copies are alike."""
        last = self._cloud.summary()
        before = self._distinct if last.stages == 1 else 1.0
        return before * min(last.effective_sample_size / self._shown, 1.0) if last.resampled else before

    def _learn(self, given: list[Given]) -> None:
        """Find out whether the particles lie together, and learn from scans at a pose that none contradicts."""
        due = due_of(self._sensors, given) if self.options.temperature == "auto" else []
        if not (due or not self._together or self._corrections % LOOK == 0):
            return
        numbers = self._cloud.estimate(self._shown)
        covariance = covariance_of(numbers)
        self._together = is_together(covariance)
        if due and self._together and not self._is_doubted() and self._cloud.summary().effective_sample_size >= 2:
            for sensor, reading in due:
                sensor.correlate(numbers[:3], covariance, reading)

    def _is_doubted(self) -> bool:
        """Tell whether the last scans that were judged contradict the pose, or a rival competes with it."""
        rival = self._rival is not None and self._rival.active
        return rival or not self._together or self._verdict.wrong > _DOUBT or self._verdict.explains_little

    def _recover(self, given: list[Given]) -> None:
        """Compare the particles with their rival, or search for one where scans contradict the pose."""
        if self.options.recovery != "sensor" or not can_search(self._sensors):
            return
        rival = self._rival
        if rival is not None and rival.active:
            rival.correct(given, evidence_of(self._cloud.summary()))
            numbers = self._cloud.estimate(self._shown)
            won = rival.judge(numbers[:3], covariance_of(numbers), given)
            if won is not None:
                self._take_over(*won)
            return
        if self._wide or (self._everywhere and not self._together):
            return
        if not (self._everywhere or self._is_doubted() or self._verdict.due):
            return
        found = self.estimate()
        if self._everywhere or self._is_doubted():
            rival = self._rival = self._rival or Rival(self._new_rival())
            prior = 0.0 if self._everywhere else PRIOR
            self._everywhere = max(self._everywhere - 1, 0)
            rival.start(found.pose, found.covariance, list(self._last.items()), step=self._step, prior=prior)

    def _new_rival(self) -> ParticleFilter:
        """Return a filter for a rival, with the sensors of this one."""
        one = self.options
        return ParticleFilter(
            self._sensors, motion=self.motion, particles=PARTICLES, seed=one.seed ^ _RIVAL, temperature=one.temperature,
            resampling=one.resampling, threshold=one.threshold, stages=one.stages, recovery=None,
        )  # fmt: skip

    def _take_over(self, poses: np.ndarray, weights: np.ndarray) -> None:
        """Replace the particles by those of the rival, which the next scans have to confirm."""
        self._place(poses[starts.rows_by_weight(weights, self._cloud.count)], again=True)
        self._verdict.doubt()
        self._everywhere = COMPARISONS

    @whole
    def reset(self) -> None:
        """Replace half of the particles by poses at which the last readings are likely (sensor resetting).

        A motion that was predicted after these readings moves the new particles, too.

        Raises:
            RuntimeError: there are no readings since the particles were initialised.
        """
        if not self._last:
            raise RuntimeError("reset: needs a correction first")
        tries = self._random_poses(resetting.tries_of(self._cloud.count))
        poses = self._cloud.host_poses(self._cloud.places.next, self._cloud.count)
        chosen = resetting.with_likely_poses(
            poses, tries, self._sensors, self._last, self.options.temperature, self._key()
        )
        self._place(chosen, again=True)

    @settled
    def flush(self) -> None:
        """Run the motion of the last ``predict`` now, as a step of its own; the next correction does it otherwise."""
        if self._pending is not None:
            self._move(None)

    @whole
    def _move(self, following: SampledMotion | None) -> None:
        """Run the pending motion; another one follows it."""
        motion = STILL if self._pending is None else self._pending
        self._cloud.move(self._settings(motion, []), motion.kind)
        self._shown, self._pending = self._cloud.count, following

    # ---- state

    @settled
    def state(self) -> FilterState:
        """Return a copy of the filter's state, without models and device: see :class:`FilterState`."""
        memory = plain_state(self, without=("_cloud", "_last", "_rival"))
        memory["rival"] = None if self._rival is None or not self._rival.active else self._rival.state()
        memory["_last"] = readings_on_host(self._last, self._backend)
        options, models = constructor_options(self.options, self.motion), model_names(self._sensors)
        return FilterState(options, models, self._cloud.contents(self._shown), memory)

    @whole
    def restore(self, state: FilterState) -> None:
        """Take over the state of a filter with the same options and models, and continue with the same bits.

        Args:
            state: The result of :meth:`state`. It can be of a filter on another device, or of one that is split over
                several.

        Raises:
            TypeError, ValueError: it is no state, or of a filter with other options or models.
        """
        given = check_state(state, constructor_options(self.options, self.motion), model_names(self._sensors))
        self._cloud.restore(given.contents)
        set_state(self, {name: value for name, value in given.memory.items() if name != "rival"})
        if given.memory["rival"] is not None:
            self._rival = self._rival or Rival(self._new_rival())
            self._rival.restore(given.memory["rival"])
        elif self._rival is not None:
            self._rival.stop()

    def __getstate__(self) -> dict[str, Any]:
        return {"models": self.models, "state": self.state()}

    def __setstate__(self, values: dict[str, Any]) -> None:
        ParticleFilter.__init__(self, values["models"], **values["state"].options)
        self.restore(values["state"])

    def _settings(self, motion: SampledMotion, given: list[int]) -> np.ndarray:
        """Return the numbers of a step."""
        temperature, sensors = self.options.temperature, []
        wide = DEFAULTS.wide_share if self._wide and temperature == "auto" else 1.0
        for sensor in (self._sensors[index] for index in given):
            sensors.append((sensor.temperature(temperature) * (wide if sensor.calibrates else 1.0), sensor.beams))
        step, count = self._key()[2], self._cloud.count
        one_peak = self._together and not any(self._sensors[index].ambiguous for index in given)
        return options.settings_of_step(self.options, motion, step, count, self._pool, sensors, one_peak)

    def _wanted(self) -> int:
        """Return the particles of the next step by KLD sampling."""
        poses = self._cloud.host_poses(self._cloud.places.next, self._cloud.count)
        return kld_count(poses, self.options.least, self.options.most)


def _copied(reading: Any) -> Any:
    """Return a copy of a NumPy array, and another object as it is."""
    return reading.copy() if isinstance(reading, np.ndarray) else reading
