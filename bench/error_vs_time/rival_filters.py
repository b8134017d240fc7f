"""Whole filters of nav2_amcl and Beluga on the drive of ``needs.py``, compiled from copies of their sources.

NAV2, BELUGA and BELUGA_INCLUDE name the copies, see ``bench/speed/filters.py``. Both run one thread. A step is motion,
weights, resampling and the pose that the program reports. Each scan is used, with as many beams as gpusense uses, and
the number of particles is fixed. *Defaults* are the parameters of the program's node: its likelihood field (a sum of
cubes), a standard deviation of 0.2 m, and 0.2 for the odometry's noise. *Product* and *beam* have the parameters of
gpusense's rows: a field whose densities are multiplied, and a beam model.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from accuracy.compiled_peers import Compiled, Follower, Weigher
from common import note
from recordings import BEAM
from speed.filters import PEERS, load
from task_settings import Setting, Steps

import gpusense as gs
from gpusense.localization.defaults import DEFAULTS

PARTICLES, BEAMS = (500, 2000, 10_000), 60
# Most particles of a beam model: these programs walk its rays cell by cell.
MOST_CAST = 2000
# By method: the peers' model; z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, max_distance; noise of odometry.
_FIELD = gs.LikelihoodFieldParameters.tracking()
_DISTANCE = _FIELD.max_distance
_CAST = gs.BeamParameters(**BEAM)
METHODS: dict[str, tuple[str, tuple[float, ...], tuple[float, ...]]] = {
    "defaults": ("field", (0.5, 0.05, 0.05, 0.5, 0.2, 0.1, 2.0), (0.2,) * 4),
    "product": (
        "field, prob", (_FIELD.z_hit, 0.0, 0.0, _FIELD.z_rand, _FIELD.sigma_hit, 0.1, _DISTANCE),
        DEFAULTS.alpha,
    ),
    "beam": (
        "beam", (_CAST.z_hit, _CAST.z_short, _CAST.z_max, _CAST.z_rand, _CAST.sigma_hit, _CAST.lambda_short, _DISTANCE),
        DEFAULTS.alpha,
    ),
}  # fmt: skip


def thinned(scanner: gs.Scanner, beams: int) -> tuple[gs.Scanner, np.ndarray]:
    """Return a scanner of evenly chosen beams, and their indices."""
    chosen = np.linspace(0, scanner.count - 1, beams).round().astype(int)
    return gs.Scanner(scanner.bearings[chosen], scanner.range_max, range_min=scanner.range_min), chosen


def rivals(run: Any, start: Sequence[float], settling: int) -> Iterator[Setting]:
    """Yield the settings of both programs, started with deviations [m, m, rad]; note the reasons of absent ones."""
    scanner, chosen = thinned(run.scanner, BEAMS)
    for name, (_, package, _) in PEERS.items():
        compiled, version, missing = load(name)
        if compiled is None:
            note(f"left out: filter of {package}: {missing}")
            continue
        for (method, (model, parameters, alpha)), count in itertools.product(METHODS.items(), PARTICLES):
            if method == "beam" and count > MOST_CAST:
                continue
            drive = Drive(compiled, run, scanner, chosen, model, parameters, alpha, count, start, settling)
            yield Setting(
                "localisation", f"{package}, {method}", f"{count} x {BEAMS}", f"{package}, {model}", "float64", drive,
                outside=f"{version}, 1 thread",
            )  # fmt: skip


class Drive:
    """A run that follows the robot with a program's filter; it returns errors of the position [m] and the steps."""

    def __init__(
        self,
        compiled: Compiled,
        run: Any,
        scanner: gs.Scanner,
        chosen: np.ndarray,
        model: str,
        parameters: Sequence[float],
        alpha: Sequence[float],
        particles: int,
        start: Sequence[float],
        settling: int,
    ) -> None:
        self._weigher = Weigher(compiled, run.grid, scanner, parameters, model)
        self._run, self._chosen, self._alpha = run, chosen, alpha
        self._particles, self._start, self._settling = particles, start, settling

    def __call__(self, seed: int) -> tuple[np.ndarray, Steps]:
        """Follow the robot once."""
        run = self._run
        follower = Follower(self._weigher, self._particles, run.poses[0], self._start, self._alpha, seed)
        errors, steps = [], Steps(settling=self._settling)
        for odometry, ranges, pose in zip(run.odometry, run.scans, run.poses, strict=True):
            with steps:
                found = follower.step(odometry, ranges[self._chosen])
            errors.append(np.hypot(*(found[:2] - pose[:2])))
        return np.array(errors[self._settling :]), steps
