"""Settings of matching for ``needs.py``: pairs of scans, scans in a map, and other programs on the pairs."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import Backend
from gpusense.evaluation.matching import differences

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from common import note
from rivals import Matcher, matchers
from task_settings import Setting, Steps

PAIRS = 60
BEAMS = (90, 180, 360, 720)
# Runs of a setting, each of one call; methods between scans that take a hundred times as long run once.
REPEATS, SLOW = 3, ("gauss_newton", "correlative")


def free_poses(grid: gs.OccupancyGrid, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses with free space around them."""
    return np.array([gs.worlds.free_pose(grid, rng, 0.4) for _ in range(count)])


@dataclass(frozen=True)
class Pairs:
    """Pairs of scans with one number of beams.

    Attributes:
        one, two: (P, K) readings of both scans [m].
        places: (P, 3) poses of the second scans.
        moved: (P, 3) these poses in the frames of the first scans.
        off: (P, 3) errors of the guesses.
    """

    grid: gs.OccupancyGrid
    scanner: gs.Scanner
    one: np.ndarray
    two: np.ndarray
    places: np.ndarray
    moved: np.ndarray
    off: np.ndarray


def pairs(device: Backend) -> Iterator[Pairs]:
    """Yield the pairs for each number of beams."""
    rng, grid = np.random.default_rng(5), gs.worlds.building(2, (50.0, 50.0))
    first = free_poses(grid, PAIRS, rng)
    second = first + rng.uniform(-1, 1, first.shape) * (1.0, 1.0, np.radians(30))
    off = rng.uniform(-1, 1, first.shape) * (0.5, 0.5, np.radians(10))
    truth = gs.pose_difference(first, second)
    for count in BEAMS:
        scanner = gs.Scanner.uniform(angle_min=-np.pi, angle_increment=2 * np.pi / count, count=count, range_max=20.0)
        caster = gs.RayCaster(grid, scanner.range_max, backend=device)
        one, two = (caster.cast(poses, scanner.bearings).astype(np.float64) for poses in (first, second))
        # A pose in a wall sees nothing.
        seen = (one.min(axis=1) > 0.1) & (two.min(axis=1) > 0.1)
        one, two = (scan + rng.normal(0, 0.02, scan.shape) * (scan < scanner.range_max) for scan in (one, two))
        yield Pairs(grid, scanner, one[seen], two[seen], second[seen], truth[seen], off[seen])


def matching(device: Backend) -> Iterator[Setting]:
    """Yield the settings of matching: methods, numbers of beams, precisions."""
    for each in pairs(device):
        count = each.scanner.count
        for need, reference, right, methods in (
            ("matching", each.one, each.moved, ("auto", "icp", "gauss_newton", "correlative")),
            ("in a map", each.grid, each.places, ("auto", "gauss_newton", "correlative")),
        ):
            for method, precision in itertools.product(methods, ("float32", "float64")):
                if precision == "float64" and (count != 360 or method != "auto" or not device.info.float64):
                    continue
                options = "" if precision == "float32" else ', precision="float64"'
                given = "grid" if need == "in a map" else "reference"
                yield Setting(
                    need, method, f"{count} beams",
                    f'gs.match_scan({given}, ranges, scanner, guess, "{method}"{options})', precision,
                    matcher(reference, each.two, each.scanner, right, each.off, method, device, precision),
                    repeats=1 if need == "matching" and method in SLOW else REPEATS,
                )  # fmt: skip


def rivals(device: Backend) -> Iterator[Setting]:
    """Yield the settings of other programs that match pairs; note the reasons of those that cannot run."""
    able = []
    for one in matchers():
        if one.match is None:
            note(f"left out: {one.method}: {one.missing}")
        else:
            able.append(one)
    for each, one in itertools.product(pairs(device) if able else (), able):

        def run(seed: int, each: Pairs = each, one: Matcher = one) -> tuple[np.ndarray, Steps]:
            guesses = each.moved + each.off
            steps = Steps(len(guesses))
            with steps:
                found = one.match(each.one, each.two, each.scanner, guesses)
            return differences(np.where(np.isfinite(found), found, guesses), each.moved)[0], steps

        yield Setting(
            "matching", one.method, f"{each.scanner.count} beams", one.code, "float64", run, outside=one.outside,
        )  # fmt: skip


def matcher(
    reference: Any,
    ranges: np.ndarray,
    scanner: gs.Scanner,
    right: np.ndarray,
    off: np.ndarray,
    method: Any,
    device: Backend,
    precision: Any,
) -> Callable[[int], tuple[np.ndarray, Steps]]:
    """Return a run that matches all pairs in one call."""

    def run(seed: int) -> tuple[np.ndarray, Steps]:
        steps = Steps(len(right))
        with steps:
            match = gs.match_scan(reference, ranges, scanner, right + off, method, device, precision=precision)
        return differences(match.pose, right)[0], steps

    return run


def in_a_map(device: Backend) -> Iterator[Setting]:
    """Yield the settings of matching in a map."""
    return (one for one in matching(device) if one.need == "in a map")


def between_scans(device: Backend) -> Iterator[Setting]:
    """Yield the settings of matching between scans."""
    return (one for one in matching(device) if one.need == "matching")
