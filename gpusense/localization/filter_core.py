"""Combine the parts of a particle filter."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from gpusense._util.typing import AnyArray
from gpusense.backends import arrays
from gpusense.localization import starts
from gpusense.localization.cloud import Cloud
from gpusense.localization.cloud_state import Contents
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.estimates import Estimate, clustered
from gpusense.localization.journal import plain_state, set_state
from gpusense.localization.motion import SampledMotion
from gpusense.localization.rival import Recovery
from gpusense.localization.sensors import Sensor, SensorReadings, grid_of, readings_of
from gpusense.localization.spread import Distances, margins_of, share_off, share_off_of, spread_of, verdict_label
from gpusense.localization.state import Options
from gpusense.localization.tracker import Tracker, is_together
from gpusense.localization.verdict import Verdict
from gpusense.world.pose_algebra import compose_poses, wrap_angle

# Number of evaluated particles; largest share of skipped beams.
_ASKED, _MOST_SKIPPED = 100, 0.7


class FilterCore:
    """Particles, the verdict on their pose, and recovery from a wrong pose."""

    MEMORY: ClassVar[tuple[str, ...]] = ("last",)

    def __init__(self, sensors: Sequence[Sensor], options: Options, cloud: Cloud) -> None:
        self.sensors, self.options = sensors, options
        self.tracker = Tracker(sensors, options, cloud)
        self.verdict = Verdict(sensors, self.tracker.random_poses, seed=options.seed)
        self.recovery = Recovery(self.tracker, self.verdict)
        # Readings of the last correction by the index of their sensor.
        self.last: dict[int, tuple[Any, ...]] = {}
        self._learners = [sensor.learner for sensor in sensors if sensor.learner is not None]
        self._owners = self.verdict, *self._learners, self.tracker, cloud, self.recovery
        self._margins = margins_of(sensors)

    def changing(self) -> tuple[Any, ...]:
        """Return the objects whose state a call may change, and keep their present buffers."""
        self.tracker.cloud.keep()
        rival = self.recovery.rival
        return (self, *self._owners) if rival is None else (self, *self._owners, *rival.changing())

    # ---- starts

    def start_around(self, mean: AnyArray, covariance: AnyArray, particles: int | None) -> None:
        """Draw particles from a normal density."""
        tracker = self.tracker
        self._begin(starts.normal(mean, covariance, tracker.number(particles), tracker.key()))
        starts.look_at(np.asarray(mean, np.float64), grid_of(self.sensors))
        tracker.together = is_together(np.asarray(covariance))

    def start_anywhere(self, bounds: AnyArray | None, particles: int | None) -> None:
        """Draw particles over the free cells of the map."""
        tracker = self.tracker
        pool, spread = starts.free_pool([sensor.model for sensor in self.sensors], bounds)
        self._begin(starts.spread(pool, spread, tracker.number(particles), tracker.key()))
        tracker.wide = DEFAULTS.wide_scans
        self.verdict.reset(anywhere=True)
        if bounds is None:
            self.recovery.expect_anywhere()

    def start_from(self, likelihood: Any, particles: int | None) -> None:
        """Draw particles from a likelihood over poses."""
        tracker = self.tracker
        count = tracker.number(particles)
        pool, spread = starts.likely_pool(likelihood, count, tracker.key())
        self._begin(starts.spread(pool, spread, count, tracker.key(), each=True))
        self.recovery.expect_anywhere()

    def _begin(self, poses: np.ndarray) -> None:
        """Replace all particles, and forget the history of the previous ones."""
        self.tracker.begin(poses)
        self.last = {}
        self.recovery.restart()
        self.verdict.reset()
        for learner in self._learners:
            learner.restart()

    # ---- steps

    def follow(self, motion: SampledMotion) -> None:
        """Move the particles and their rival."""
        self.tracker.follow(motion)
        if (rival := self.recovery.rival) is not None:
            rival.follow(motion)

    def correct(self, readings: Any) -> None:
        """Weigh the particles by readings; see ``ParticleFilter.correct``."""
        tracker, verdict, share = self.tracker, self.verdict, self.options.beam_skip
        tracker.check_started()
        used = readings_of(readings, self.sensors)
        if not used:
            return
        scans, everything = used, dict(used)
        if verdict.watches(everything):
            verdict.predicted(*tracker.moved_particles(), everything)
        if share is not None:
            particles = tracker.moved_particles()
            if is_together(tracker.mean_and_covariance()[1]):
                used = skipped(self.sensors, used, particles, verdict.anywhere, share)
        judged = verdict.expected(scans, tracker.progress.motion)
        tracker.weigh(used, judged=judged, meanwhile=functools.partial(self._use_wait, everything))
        tracker.learn(used, self.recovery.is_doubted)
        for learner in self._learners:
            if learner.lessons:
                learner.exchange()
        self.recovery.corrected(used, self.last)

    def _use_wait(self, readings: dict[int, tuple[Any, ...]]) -> None:
        """Count a correction, and continue lessons of earlier ones unless scans contradict the pose."""
        self.last = readings
        for learner in self._learners:
            if learner.lessons:
                learner.work(doubted=self.recovery.is_doubted())
        self.verdict.corrected()

    def reset(self) -> None:
        """Replace half of the particles by poses that make the last readings likely, moved by all later motion."""
        tracker = self.tracker
        tracker.move()
        count, temperature = tracker.cloud.count, self.options.temperature
        likely = starts.likeliest(tracker.random_poses, count, self.sensors, self.last, temperature)
        moved = compose_poses(likely, tracker.progress.moved or np.zeros(3))
        tracker.place(starts.with_poses(tracker.next_particles(), moved, tracker.key()))

    # ---- results

    def estimate(self, method: str) -> Estimate:
        """Return the estimate by "mean", "cluster" or "best"."""
        tracker, verdict, rival = self.tracker, self.verdict, self.recovery.rival
        cloud, shown = tracker.cloud, tracker.shown
        _, (mean, covariance), spread = tracker.described()
        summary = cloud.summary()
        # Copies, which belong to the caller.
        pose, covariance = mean.copy(), covariance.copy()
        about, far = covariance, spread
        if method != "mean":
            if method == "best":
                pose = tracker.host_particles()[int(np.argmax(cloud.host_weights(shown)))]
            else:
                pose, covariance = clustered(tracker.host_particles(), cloud.host_weights(shown))
                spread = spread_of(covariance)
            offset = pose - mean
            offset[2] = wrap_angle(offset[2])
            about = about + np.outer(offset, offset)
            far = spread_of(about)
        if far.narrow:
            share, distances = share_off(about, far), None
        else:
            particles = cloud.snapshot(shown)
            share = cloud.far_share(shown) if method == "mean" else share_off_of(*particles(), pose)
            distances = Distances(particles, pose)
        if rival is not None:
            share = 1 - (1 - share) * (1 - rival.probability(pose))
        wrong = verdict.wrong
        p_lost = wrong + (1 - wrong) * share
        word = verdict_label(p_lost, wrong, wide=spread.wide, apart=spread.apart)
        temperature = tracker.sensors[0].temperature(tracker.options.temperature)
        margins = self._margins if verdict.informed and verdict.state.corrections else (1.0, 0.0)
        return Estimate(
            pose, covariance, tracker.sample_size(), p_lost, word, verdict.state.explained, temperature,
            summary.temperature, summary.degenerate, shown, *margins,
            None if method == "mean" else about, distances,
        )  # fmt: skip

    # ---- state

    def state(self) -> tuple[Contents, dict[str, Any]]:
        """Return particles and memory as plain data."""
        tracker = self.tracker
        for learner in self._learners:
            learner.receive()
        contents, mine = tracker.state()
        memory = {
            "tracker": mine, "verdict": plain_state(self.verdict), "recovery": self.recovery.state(),
            "learners": [plain_state(learner) for learner in self._learners],
            "readings": {index: tuple(map(self._on_host, reading)) for index, reading in self.last.items()},
        }  # fmt: skip
        return contents, memory

    def _on_host(self, part: Any) -> Any:
        """Return a part of a reading in host memory."""
        plain = part is None or isinstance(part, (int, float, str))
        return part if plain else arrays.copied_to_host(part, self.tracker.cloud.backend, "readings")

    def restore(self, contents: Contents, memory: Mapping[str, Any]) -> None:
        """Take over particles and memory."""
        self.tracker.restore(contents, memory["tracker"])
        set_state(self.verdict, memory["verdict"])
        for learner, values in zip(self._learners, memory["learners"], strict=True):
            set_state(learner, values)
        self.recovery.restore(memory["recovery"])
        self.last = {index: tuple(map(copy.copy, reading)) for index, reading in memory["readings"].items()}


# ---- beams to skip


def skipped(
    sensors: Sequence[Sensor],
    readings: list[SensorReadings],
    particles: tuple[np.ndarray, np.ndarray],
    anywhere: np.ndarray,
    share: float,
) -> list[SensorReadings]:
    """Return readings without the beams that less than a share of (N, 3) particles, by (N,) weights, explains.

    In nav2_amcl's ``do_beamskip`` a particle explains a beam that ends within 0.5 m of a wall. Here it explains a beam
    that it makes likelier than poses anywhere do, so that any model of scans can skip. Unlike there, nonexistent beams
    do not count as skipped, and a scan with too many skipped beams is used completely. So are all scans while the
    particles are spread out, since then only the few right particles explain most beams.
    """
    every = max(len(particles[0]) // _ASKED, 1)
    few = particles[0][::every], particles[1][::every]
    return [
        (i, without_skipped(sensors[i], reading, *few, anywhere, share) if sensors[i].calibrates else reading)
        for i, reading in readings
    ]


def without_skipped(
    sensor: Sensor,
    reading: tuple[Any, ...],
    poses: np.ndarray,
    weights: np.ndarray,
    elsewhere: np.ndarray,
    share: float,
) -> tuple[Any, ...]:
    """Return a scan with missing readings for the beams that less than a share of the particles explains."""
    _, parts = sensor.model.log_likelihood(np.vstack([poses, elsewhere]), *reading, per_beam=True)
    near, far = np.split(np.asarray(parts, np.float64), [len(poses)])
    used = (near != 0).any(axis=0)
    least = boundary(far[:, used])
    if least is None:
        return reading
    explained = weights @ (near > least) >= share * weights.sum()
    if np.count_nonzero(used & ~explained) > _MOST_SKIPPED * np.count_nonzero(used):
        return reading
    ranges = np.array(arrays.copied_to_host(reading[0], sensor.backend, "ranges"))
    ranges[~(used & explained)] = np.nan
    return (ranges, *reading[1:])


def boundary(elsewhere: np.ndarray) -> float | None:
    """Return the least log-likelihood of an explained beam, from (M, K) at poses anywhere; None if all are alike."""
    values = elsewhere[np.isfinite(elsewhere)]
    if not values.size:
        return None
    poor, good = np.percentile(values, (50, 99))
    return float((poor + good) / 2) if good > poor else None
