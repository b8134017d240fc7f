"""Pairs of scans with known poses, for fitting and testing the probabilities that matches report.

Recordings are split by name before anything is fitted: alternate names in alphabetical order, both lasers of a run
together. Half A and simulations are for fits, half B only for tests.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.evaluation.log_steps import read_steps
from gpusense.evaluation.matching import WRONG, WRONG_TURN
from gpusense.evaluation.worlds import free_pose
from gpusense.matching.result import ScanMatch

HALF_A = ("acapulco", "belgioioso", "fhw", "infinite-corridor", "jarvis-s3000", "jarvis-nav350", "seattle")
HALF_B = ("aces", "csail", "freiburg-079", "intel", "olin")
# Readings of at least this are "no return" [m].
_FARTHEST = {
    "acapulco": 49.9, "aces": 49.9, "belgioioso": 81.9, "csail": 81.9, "fhw": 51.0, "freiburg-079": 81.9,
    "infinite-corridor": 50.9, "intel": 81.8, "seattle": 81.9,
}  # fmt: skip
# Errors of guesses [m, m, rad].
GUESS = np.array([0.5, 0.5, 0.17])
# Least distance of unrelated places [m]: recorded ones, and simulated ones, which are in different rooms.
UNRELATED, UNRELATED_SIMULATED = 20.0, 3.0


@dataclass(frozen=True)
class Pairs:
    """Pairs of scans.

    Attributes:
        half: "A", "B", or "S" for simulations.
        name: The recording, or the map and the number of beams.
        kind: "successive", "near", "places" or "unrelated".
        first: (S, K) readings of the references [m].
        second: (S, K) readings of the second scans [m].
        guess: (S, 3) guesses.
        truth: (S, 3) poses of the second robot frames in the first ones.
    """

    half: str
    name: str
    kind: str
    scanner: gs.Scanner
    first: np.ndarray
    second: np.ndarray
    guess: np.ndarray
    truth: np.ndarray

    def match(self, backend: str) -> ScanMatch:
        """Match the pairs."""
        return gs.match_scan(self.first, self.second, self.scanner, self.guess, backend=backend)

    def right(self, match: ScanMatch) -> np.ndarray:
        """Return which poses have errors of at most 0.2 m and 5 degrees along their observed directions."""
        off = match.pose - self.truth
        off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
        off[:, 2] *= match.lever
        along = np.where(match.eigenvalues == 0, 0, np.einsum("sij,sj->si", match.directions, off))
        off = np.einsum("sij,si->sj", match.directions, along)
        good: np.ndarray = (np.hypot(off[:, 0], off[:, 1]) <= WRONG) & (np.abs(off[:, 2]) <= WRONG_TURN * match.lever)
        return good & (self.kind != "unrelated")


def data() -> Path:
    """Return the folder of recorded data."""
    return Path(os.environ["GPUSENSE_DATA"])


def recording(name: str) -> tuple[np.ndarray, gs.Scanner, np.ndarray, np.ndarray]:
    """Return readings (S, K), the scanner, reference poses and odometry (S, 3) of a recording."""
    if name in _FARTHEST:
        steps = read_steps(data() / "carmen_logs" / f"{name}-corrected.log.gz")
        ranges = np.array([step.scan.ranges for step in steps])
        ranges[ranges >= _FARTHEST[name]] = np.inf
        poses, odometry = (
            np.array([pose(step) for step in steps]) for pose in (lambda s: s.scan.pose, lambda s: s.odometry)
        )
        return ranges, steps[0].scan.scanner, poses, odometry
    from recordings import load

    run = load(name)
    events = run.events
    return (
        np.array([e.ranges for e in events]), run.places[0][1], np.array([e.truth for e in events]),
        np.array([e.odometry for e in events]),
    )  # fmt: skip


def recorded_pairs(name: str, count: int, seed: int) -> Iterator[Pairs]:
    """Yield pairs of a recording: successive scans, near ones, places 1 to 4 m apart, and unrelated places."""
    ranges, scanner, poses, odometry = recording(name)
    half, rng = "A" if name in HALF_A else "B", np.random.default_rng(seed)

    def made(kind: str, i: np.ndarray, j: np.ndarray, guess: np.ndarray | None = None) -> Pairs:
        truth = gs.pose_difference(poses[i], poses[j])
        if guess is None:
            guess = (0 if kind == "unrelated" else truth) + rng.uniform(-1, 1, truth.shape) * GUESS
        return Pairs(half, name, kind, scanner, ranges[i], ranges[j], guess, truth)

    for step, kind in ((1, "successive"), (3, "near")):
        i = rng.integers(0, len(ranges) - step, count)
        i = i[np.hypot(*(poses[i + step] - poses[i]).T[:2]) < 3]
        yield made(kind, i, i + step, gs.pose_difference(odometry[i], odometry[i + 1]) if step == 1 else None)
    i, j = rng.integers(0, len(ranges), (2, 60 * count))
    apart = np.hypot(*(poses[j] - poses[i]).T[:2])
    for kind, low, high, most in (("places", 1.0, 4.0, count // 2), ("unrelated", UNRELATED, np.inf, 2 * count)):
        chosen = np.flatnonzero((apart > low) & (apart < high))[:most]
        if len(chosen):
            yield made(kind, i[chosen], j[chosen])


def scanners() -> list[gs.Scanner]:
    """Return the scanners of simulations."""
    sizes = ((90, 181, 30.0), (180, 360, 12.0), (135, 541, 30.0), (180, 720, 25.0), (135, 1081, 30.0), (180, 36, 20.0),
             (180, 16, 20.0), (180, 10, 20.0))  # fmt: skip
    return [
        gs.Scanner.uniform(
            angle_min=-np.radians(half), angle_increment=2 * np.radians(half) / count, count=count, range_max=far
        )
        for half, count, far in sizes
    ]


def with_people(ranges: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return a scan in which people hide a share of the beams, in runs of neighbours."""
    ranges, left = ranges.copy(), int(share * len(ranges))
    while left > 0:
        width = int(rng.integers(2, max(3, len(ranges) // 30)))
        hidden = (int(rng.integers(len(ranges))) + np.arange(width)) % len(ranges)
        nearest = np.where(np.isfinite(ranges[hidden]), ranges[hidden], 8.0).min()
        ranges[hidden] = np.minimum(ranges[hidden], rng.uniform(0.3, 1.0) * nearest)
        left -= width
    return ranges


def simulated_pairs(backend: str, count: int, seed: int) -> Iterator[Pairs]:
    """Yield pairs of scans in generated buildings and maps, with noise of 0.5 to 5 cm and up to 30 % of people."""
    rng = np.random.default_rng(seed)
    maps = {f"building {i}": gs.worlds.building(i) for i in range(6)}
    for name in ("levinelobby", "basement_hallways_5cm", "tb3_sandbox"):
        maps[name] = gs.read_map(data() / "ros_maps" / f"{name}.yaml")
    for name, grid in maps.items():
        for scanner in scanners():
            caster = gs.RayCaster(grid, scanner.range_max, backend=backend)
            noise, share = rng.choice((0.005, 0.015, 0.03, 0.05)), rng.choice((0.0, 0.0, 0.1, 0.3))
            first = np.array([free_pose(grid, rng) for _ in range(2 * count)])
            second = first + rng.uniform(-1, 1, first.shape) * (0.7, 0.7, 0.3)
            exact = [caster.cast(poses, scanner.bearings).astype(np.float64) for poses in (first, second)]
            seen = (exact[0].min(axis=1) > 0.1) & (exact[1].min(axis=1) > 0.1)
            first, second = first[seen], second[seen]
            one, two = (
                np.array([
                    with_people(np.where(z < scanner.range_max, z + rng.normal(0, noise, len(z)), np.inf), share, rng)
                    for z in scans[seen]
                ]) for scans in exact
            )  # fmt: skip
            label = f"{name}, {scanner.count} beams, {100 * noise:g} cm"
            truth = gs.pose_difference(first, second)
            guess = truth + rng.uniform(-1, 1, truth.shape) * GUESS
            yield Pairs("S", label, "near", scanner, one, two, guess, truth)
            other = np.roll(np.arange(len(two)), len(two) // 2)
            truth = gs.pose_difference(first, second[other])
            far = np.hypot(truth[:, 0], truth[:, 1]) > UNRELATED_SIMULATED
            guess = rng.uniform(-1, 1, truth.shape) * GUESS
            if far.any():
                yield Pairs("S", label, "unrelated", scanner, one[far], two[other][far], guess[far], truth[far])
