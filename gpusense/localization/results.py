"""Results of a particle filter: poses, particles, weights, and what it says of itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import BackendInfo
from gpusense.backends.base import Backend
from gpusense.localization.diagnosis import Diagnosis, diagnose
from gpusense.localization.estimates import Estimate, clustered, covariance_of
from gpusense.localization.filter_cloud import FilterCloud
from gpusense.localization.journal import Whole, settled
from gpusense.localization.options import Options
from gpusense.localization.rival import Rival, evidence_of
from gpusense.localization.sensors import Sensor
from gpusense.localization.spread import is_apart, is_narrow, is_wide, share_off, share_off_of
from gpusense.localization.verdict import Verdict
from gpusense.localization.words import word_of
from gpusense.world.grid import OccupancyGrid

# Most particles whose spread is counted one by one; of more, and of narrow clouds, a normal density is taken.
_MOST_LOOKED_AT = 100_000


class Results(Whole, ABC):
    """The part of a particle filter that reads its state.

    Attributes:
        options: The options, checked.
    """

    options: Options
    _backend: Backend
    _cloud: FilterCloud
    _sensors: list[Sensor]
    _verdict: Verdict
    # Whether there are particles, the number of those that are shown, and the last readings.
    _started: bool
    _shown: int
    # The rival of the particles, if there was one.
    _rival: Rival | None
    # Share of distinct particles before the last correction.
    _distinct: float
    _last: dict[int, tuple[Any, ...]]

    @abstractmethod
    def _random_poses(self, count: int) -> np.ndarray:
        """Return poses anywhere in the free space."""

    @abstractmethod
    def flush(self) -> None:
        """Run the motion of the last ``predict`` now."""

    def _check_started(self) -> None:
        if not self._started:
            raise RuntimeError(
                "ParticleFilter: must be initialised first, by initialize, initialize_uniform or initialize_from"
            )

    @property
    def device(self) -> BackendInfo:
        """The device of all state."""
        return self._backend.info

    @property
    @settled
    def count(self) -> int:
        """Number of particles of the next step."""
        return self._cloud.count

    # The verdict's state is one assignment.
    @settled
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
            poses = self._cloud.host_poses(self._cloud.places.shown, self._shown)
            if method == "best":
                pose = poses[int(np.argmax(self._cloud.host_weights(self._shown)))]
            else:
                pose, covariance = clustered(poses, self._cloud.host_weights(self._shown))
        explained = self._verdict.judge(pose, covariance, self._last, evidence_of(summary))
        p_lost = self._p_lost(pose, covariance)
        word = word_of(p_lost, self._verdict.wrong, wide=is_wide(covariance), apart=is_apart(covariance))
        size = summary.effective_sample_size
        if not size > 0:
            # The kernels have summed no squares: before a correction, or where no weighted particle was possible.
            weights = self._cloud.host_weights(self._shown)
            size = float(weights.sum() ** 2 / (weights @ weights))
        size *= self._distinct
        return Estimate(
            pose, covariance, size, p_lost, word, explained, self.temperatures[0], summary.temperature,
            summary.degenerate, self._shown,
        )  # fmt: skip

    @settled
    def diagnose(self, *, search: bool = True) -> Diagnosis:
        """Return the evidence of the last readings at the estimate, and the likely cause where they contradict it.

        Args:
            search: Whether to look for a better pose elsewhere on the map, which takes some milliseconds.

        Raises:
            RuntimeError: the filter is not initialised.
        """
        pose, _ = self.mean_and_covariance()
        search = search and any(hasattr(sensor.model, "grid") for sensor in self._sensors)
        return diagnose(self._sensors, self._last, pose, self._random_poses if search else None)

    def _p_lost(self, pose: np.ndarray, covariance: np.ndarray) -> float:
        """Return the probability that a pose is far off, by the scans and by the particles."""
        if is_narrow(covariance) or self._shown > _MOST_LOOKED_AT:
            share = share_off(covariance)
        else:
            poses = self._cloud.host_poses(self._cloud.places.shown, self._shown)
            share = share_off_of(poses, self._cloud.host_weights(self._shown), pose)
        if self._rival is not None:
            share = 1 - (1 - share) * (1 - self._rival.probability(pose))
        wrong = self._verdict.wrong
        return wrong + (1 - wrong) * share

    @settled
    def mean_and_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted mean (3,) and the covariance (3, 3), without the verdict of :meth:`estimate`."""
        self._check_started()
        self.flush()
        numbers = self._cloud.estimate(self._shown)
        return numbers[:3].copy(), covariance_of(numbers)

    @property
    def models(self) -> tuple[Any, ...]:
        """The measurement models, in the order of ``temperatures``."""
        return tuple(sensor.model for sensor in self._sensors)

    @property
    @settled
    def temperatures(self) -> tuple[float, ...]:
        """Temperature of each model now."""
        return tuple(sensor.temperature(self.options.temperature) for sensor in self._sensors)

    @property
    @settled
    def gain(self) -> float:
        """Mean gain of recent features over features anywhere or false ones [nats]; below 1 the filter is lost.

        NaN without a landmark model, and before 20 scans with features.
        """
        return self._verdict.gain

    @property
    def scoring_seconds(self) -> float:
        """Seconds that the models' log-likelihoods have taken, if ``time_scoring`` was called before.

        Without it they are the seconds in which they were started; 0 where a step is one recorded program. Those of a
        filter over several devices are added up.
        """
        return self._cloud.scoring_seconds

    def time_scoring(self) -> None:
        """Wait for the log-likelihoods of each stage from now on, so that ``scoring_seconds`` is their time."""
        self._cloud.time_scoring()

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

    @settled
    def host_particles(self) -> np.ndarray:
        """Return a copy of the (N, 3) poses after the last step in host memory."""
        self._check_started()
        self.flush()
        return self._cloud.host_poses(self._cloud.places.shown, self._shown)

    @settled
    def host_weights(self) -> np.ndarray:
        """Return a copy of the (N,) weights of the particles in host memory; their sum is 1."""
        self._check_started()
        self.flush()
        weights = self._cloud.host_weights(self._shown)
        return weights / weights.sum()

    @property
    @settled
    def particles(self) -> Any:
        """(N, 3) poses after the last step: on a GPU an array of the device, which other libraries use in place."""
        self._check_started()
        self.flush()
        return self._cloud.particles(self._shown)

    @property
    @settled
    def weights(self) -> Any:
        """(N,) weights of the particles, whose sum is 1: on a GPU an array of the device."""
        self._check_started()
        self.flush()
        return self._cloud.shares(self._shown)

    @property
    @settled
    def moments(self) -> Any:
        """(9,) mean x, y, theta and covariance xx, xy, xt, yy, yt, tt: on a GPU an array of the device."""
        self._check_started()
        self.flush()
        return self._cloud.moments(self._shown)

    def explain(self) -> str:
        """Return in one line how a step is started on the device."""
        return self._cloud.explain()
