"""Localise a robot along a recorded log, and evaluate the track: errors, coverage, time to converge, time per step."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense._util.typing import Floats
from gpusense.evaluation.log_steps import Step, repeats_odometry
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.filter import ParticleFilter
from gpusense.localization.spread import WORDS, Word
from gpusense.world.pose_algebra import pose_difference, wrap_angle

# Largest errors of the next scans of a converged track [m, rad].
CONVERGED, CONVERGED_TURN, CONVERGED_SCANS = 1.0, math.radians(20), 5
RISK = 0.05
"""Probability that an error exceeds the reported radius, by default."""
# Most scans that give the verdict at the end.
_TAIL = 10
# Deviations of a tracking start: x, y [m] and heading [rad].
START = DEFAULTS.start
# Quantiles of chi-square with 3 degrees of freedom, and of the normal density; bins of the rank histogram.
REGIONS = {"50": 2.366, "80": 4.642, "95": 7.815}
# Particles of a block.
_BLOCK = 4096


@dataclass
class Track:
    """Estimated poses along a log.

    Attributes:
        ranks: Ranks of the reference poses among the particles (:func:`rank_of`), of the steps that have one.
        p_lost: Probabilities that the estimates are off by more than 1 m or 0.5 rad.
        verdicts: "tracking", "uncertain" or "lost" for each estimate.
        explained: Shares of beams that the estimates explain; NaN for a scan without beams.
        radii: Radii that errors exceed with at most the probability ``RISK`` [m].
        seconds: Seconds of each step: predict, correct, estimate.
    """

    steps: list[Step] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    covariances: list[Floats] = field(default_factory=list)
    ranks: list[Floats] = field(default_factory=list)
    sizes: list[float] = field(default_factory=list)
    p_lost: list[float] = field(default_factory=list)
    verdicts: list[Word] = field(default_factory=list)
    explained: list[float] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    temperatures: list[float] = field(default_factory=list)
    seconds: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, pf: ParticleFilter, step: Step, clock: list[float]) -> None:
        """Add the estimate after a step; ``clock`` contains the times before predict, correct and estimate."""
        found = pf.estimate()
        predict, correct, estimate = np.diff([*clock, time.perf_counter()]).tolist()
        self.seconds.append((predict, correct, estimate))
        if step.reference is not None:
            self.ranks.append(rank_of(pf.host_particles(), pf.host_weights(), np.array(step.reference)))
        self.poses.append(found.pose)
        self.covariances.append(found.covariance)
        self.sizes.append(found.effective_sample_size)
        self.p_lost.append(found.p_lost)
        self.verdicts.append(found.verdict)
        self.explained.append(found.explained)
        self.radii.append(found.protection_level(RISK))
        self.temperatures.append(found.temperature)
        self.steps.append(step)

    @property
    def verdict(self) -> Word:
        """Most frequent verdict of the last tenth of the scans, at most 10; in a tie, the worse verdict."""
        tail = self.verdicts[-min(max(len(self.verdicts) // 10, 1), _TAIL) :]
        return max(WORDS, key=lambda word: (tail.count(word), WORDS.index(word)))

    @property
    def converged(self) -> int | None:
        """First scan with the verdict "tracking"; None if there is none."""
        return next((k for k, word in enumerate(self.verdicts) if word == "tracking"), None)

    @property
    def references(self) -> Floats | None:
        """(S, 3) reference poses, NaN where unknown; None without any."""
        unknown = (math.nan,) * 3
        known = [unknown if step.reference is None else step.reference for step in self.steps]
        poses = np.array(known, np.float64).reshape(-1, 3)
        return poses if np.isfinite(poses).any() else None

    def differences(self) -> Floats | None:
        """Return (S, 3) estimates less reference poses, headings wrapped, NaN where unknown; None without any."""
        references = self.references
        if references is None:
            return None
        difference = np.array(self.poses).reshape(-1, 3) - references
        difference[:, 2] = wrap_angle(difference[:, 2])
        return difference

    def errors(self) -> tuple[Floats, Floats] | None:
        """Return the errors of position [m] and heading [rad] of each scan; see :meth:`differences`."""
        difference = self.differences()
        return None if difference is None else (np.hypot(*difference[:, :2].T), np.abs(difference[:, 2]))


def start(
    pf: ParticleFilter,
    steps: Sequence[Step],
    *,
    everywhere: bool,
    pose: Sequence[float] | None = None,
    covariance: Floats | None = None,
) -> None:
    """Initialise a filter everywhere, or around a pose with a (3, 3) covariance; by default the first reference."""
    first = steps[0].reference if pose is None else pose
    if everywhere:
        pf.initialize_uniform()
    elif first is None:
        rule = "must have a pose at the first chosen scan, got none; where does the robot start?"
        raise ValueError(f"log: {rule} Add --start X Y THETA, or --global to begin anywhere")
    else:
        pf.initialize(mean=first, covariance=np.diag(np.square(START)) if covariance is None else covariance)


def follow(pf: ParticleFilter, steps: Iterable[Step], track: Track) -> Iterable[Step]:
    """Run a filter along a log; yield each step after it was added to the track."""
    for step in steps:
        clock = [time.perf_counter()]
        if track.steps:
            pf.predict(track.steps[-1].odometry, step.odometry)
        clock.append(time.perf_counter())
        pf.correct({pf.models[step.sensor]: step.scan.ranges})
        clock.append(time.perf_counter())
        track.add(pf, step, clock)
        yield step


def summary(track: Track) -> dict[str, Any]:
    """Return figures of a track: errors, coverage, convergence, verdict and times.

    Figures against reference poses are None without them, as is the median share of explained beams without beams.
    """
    count = len(track.steps)
    seconds = np.array(track.seconds).reshape(-1, 3) * 1000
    means = np.median(seconds, axis=0)
    tail = max(count // 10, 1)
    result: dict[str, Any] = {
        "scans": count,
        "verdict": track.verdict,
        "lost": track.verdict == "lost",
        "p_lost": float(track.p_lost[-1]),
        "scans_lost": track.verdicts.count("lost"),
        "scans_uncertain": track.verdicts.count("uncertain"),
        "tracking_since": track.converged,
        "odometry_moves": len({step.odometry for step in track.steps}) > 1,
        "explained_at_end": _median(track.explained[-tail:]),
        "explained_median": _median(track.explained),
        "temperature": track.temperatures[-1],
        "effective_sample_size_median": float(np.median(track.sizes)),
    }
    result |= dict(zip(("ms_predict", "ms_correct", "ms_estimate"), map(float, means), strict=True))
    differences, references = track.differences(), track.references
    if differences is None or references is None:
        return result | {"references": 0, "references_repeat_odometry": False} | dict.fromkeys(_WITH_REFERENCE)
    known = np.flatnonzero(np.isfinite(references[:, 0]))
    result |= {"references": len(known), "references_repeat_odometry": repeats_odometry(track.steps)}
    result |= _errors(differences[known], references[known], np.array(track.poses)[known])
    if result["converged_at"] is not None:
        result["converged_at"] = int(known[result["converged_at"]])
    return result | coverage_report(differences[known], np.array(track.covariances)[known], np.array(track.ranks))


def _median(shares: Sequence[float]) -> float | None:
    """Return the median of the known shares; None without any."""
    known = [share for share in shares if not math.isnan(share)]
    return float(np.median(known)) if known else None


def _errors(differences: Floats, references: Floats, poses: Floats) -> dict[str, Any]:
    """Return statistics of the errors of (S, 3) poses, and of the motions between successive poses."""
    position, heading = np.hypot(*differences[:, :2].T), np.abs(differences[:, 2])
    step = np.zeros((1, 3))
    if len(poses) > 1:
        step = pose_difference(pose_difference(references[:-1], references[1:]), pose_difference(poses[:-1], poses[1:]))
    step_errors = np.hypot(step[:, 0], step[:, 1])
    start = _converged(position, heading)
    settled = slice(len(position) if start is None else start, None)
    parts = (position, heading, step_errors, position[settled], heading[settled])
    values = [None if not len(part) else float(np.percentile(part, q)) for part in parts for q in (50, 95)]
    early = float(np.median(position[:start])) if start else None
    return dict(zip(_ERRORS, (*values, early, start), strict=True))


_ERRORS = (
    "error_median", "error_95", "heading_median", "heading_95", "relative_median", "relative_95", "settled_median",
    "settled_95", "settled_heading_median", "settled_heading_95", "early_median", "converged_at",
)  # fmt: skip
_WITH_REFERENCE = (
    *_ERRORS, *(f"coverage_{name}" for name in REGIONS), "nees_median", "width_95", "width_heading_95",
    "rank_histogram",
)  # fmt: skip


def _converged(position: Floats, heading: Floats) -> int | None:
    """Return the first scan after which the next ones are near the truth; None without one."""
    near = (position < CONVERGED) & (heading < CONVERGED_TURN)
    length = min(CONVERGED_SCANS, len(near))
    return next((i for i in range(len(near) - length + 1) if near[i : i + length].all()), None)


_NORMAL_95, _BINS = 1.96, 10


def nees_of(differences: Floats, covariances: Floats) -> Floats:
    """Return normalised squared errors of (S, 3) differences (headings wrapped) with their (S, 3, 3) covariances."""
    regular = covariances + 1e-12 * np.eye(3)
    solved = np.linalg.solve(regular, differences[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("si,si->s", differences, solved))


def rank_of(particles: Floats, weights: Floats, truth: Floats) -> Floats:
    """Return the weights (3,), 0 to 1, of (N, 3) particles behind, right of and clockwise of a (3,) true pose."""
    cosine, sine = math.cos(truth[2]), math.sin(truth[2])
    behind = np.zeros(3)
    # In blocks that stay in a cache: a sign is -1 behind the pose, and 0 at it.
    for begin in range(0, len(particles), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        dx, dy, turn = particles[block].T - truth[:, None]
        turn -= math.tau * np.rint(turn / math.tau)
        signs = np.sign([cosine * dx + sine * dy, cosine * dy - sine * dx, turn])
        behind += weights[block].sum() - signs @ weights[block]
    # Rounding may lead beyond the ends.
    return np.clip(0.5 * behind, 0.0, 1.0)


def coverage_report(differences: Floats, covariances: Floats, ranks: Floats) -> dict[str, Any]:
    """Return the figures of S estimates: coverage, width of intervals, NEES, rank histogram.

    Widths are medians of 95 % intervals, of the position in its least certain direction [m] and of the heading [rad].

    ``differences``: (S, 3) estimates less true poses, headings wrapped. ``covariances``: (S, 3, 3) covariances of the
    estimates. ``ranks``: (S, 3) ranks of the true poses.
    """
    squared = nees_of(differences, covariances)
    largest = np.maximum(np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1], 0)
    counts = np.histogram(ranks, bins=_BINS, range=(0, 1))[0]
    return {
        **{f"coverage_{name}": float(np.mean(squared < limit)) for name, limit in REGIONS.items()},
        "nees_median": float(np.median(squared)),
        "width_95": float(np.median(2 * _NORMAL_95 * np.sqrt(largest))),
        "width_heading_95": float(np.median(2 * _NORMAL_95 * np.sqrt(np.maximum(covariances[:, 2, 2], 0)))),
        "rank_histogram": (counts / max(int(counts.sum()), 1)).round(4).tolist(),
    }
