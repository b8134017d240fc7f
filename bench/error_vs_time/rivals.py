"""Other programs for ``needs.py``: matchers of scans, small_gicp where it is installed and CSM, and whole filters.

small_gicp (``pip install small_gicp``) aligns clouds in space. ``icp`` gets the end points at height 0; ``gicp`` gets
them at three heights, so that walls are vertical planes. CSM (Censi 2008) is compiled if the variable CSM names a copy
of its sources; GSL names the folder with GSL's ``include`` and ``lib`` if the compiler does not find them. Both run one
thread, pair by pair.

Filters are nav2_amcl's and Beluga's, compiled from copies of their sources that NAV2, BELUGA and BELUGA_INCLUDE name,
see ``bench/speed/filters.py``. Both run one thread. A step is motion, weights, resampling and the pose that the program
reports. Each scan is used, with as many beams as gpusense uses, and the number of particles is fixed. *Defaults* are
the parameters of the program's node: its likelihood field (a sum of cubes), a standard deviation of 0.2 m, and 0.2 for
the odometry's noise. *Product* and *beam* have the parameters of gpusense's rows: a field whose densities are
multiplied, and a beam model.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import chaining_peers
from accuracy.compiled_peers import Compiled, Follower, Weigher
from common import note
from recordings import BEAM
from speed.filters import PEERS, load
from task_settings import Setting, Steps

import gpusense as gs
from gpusense.localization.defaults import DEFAULTS

# Heights of the copies of a scan [m], and the cell size to which clouds are thinned [m].
HEIGHTS, THINNED = (-0.1, 0.0, 0.1), 0.02
# Largest distance between corresponding points [m]; guesses are off by at most half a metre and 10 degrees.
REACH = 1.0
_kept: list[tempfile.TemporaryDirectory[str]] = []
Match = Callable[[np.ndarray, np.ndarray, gs.Scanner, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Matcher:
    """A program that matches pairs.

    Attributes:
        match: Function of (P, K) ranges of both scans, scanner and (P, 3) guesses that returns (P, 3) poses of the
            second scan in the frame of the first; NaN where it fails.
    """

    method: str
    code: str
    outside: str
    match: Match | None
    missing: str = ""


def matchers() -> Iterator[Matcher]:
    """Yield all matchers; ``missing`` says why one cannot run."""
    yield from small_gicp()
    yield csm()


def small_gicp() -> Iterator[Matcher]:
    """Yield the methods of small_gicp."""
    try:
        import small_gicp as library
    except ImportError as error:
        missing, library = f"not installed ({error}): pip install small_gicp", None
    else:
        missing = ""
    for kind, heights in (("ICP", (0.0,)), ("GICP", HEIGHTS)):
        code = f'small_gicp.align(first, second, guess, "{kind}", max_correspondence_distance={REACH:g})'
        found = None if library is None else _aligner(library, kind, heights)
        yield Matcher(f"small_gicp {kind.lower()}", code, f"small_gicp {_version()}, 1 thread", found, missing)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("small_gicp")
    except PackageNotFoundError:
        return "unknown"


def _aligner(library: Any, kind: str, heights: tuple[float, ...]) -> Match:
    def points(ranges: np.ndarray, scanner: gs.Scanner) -> np.ndarray:
        hit = (ranges > scanner.range_min) & (ranges < scanner.range_max)
        z, bearings = ranges[hit], scanner.bearings[hit]
        flat = np.stack([z * np.cos(bearings), z * np.sin(bearings)], axis=1)
        return np.concatenate([np.column_stack([flat, np.full(len(flat), height)]) for height in heights])

    def match(first: np.ndarray, second: np.ndarray, scanner: gs.Scanner, guesses: np.ndarray) -> np.ndarray:
        poses = np.full((len(first), 3), np.nan)
        for i, (x, y, turn) in enumerate(guesses):
            start = np.eye(4)
            start[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
            start[:2, 3] = x, y
            found = library.align(
                points(first[i], scanner), points(second[i], scanner), start, kind,
                downsampling_resolution=THINNED, max_correspondence_distance=REACH, num_threads=1,
            ).T_target_source  # fmt: skip
            poses[i] = found[0, 3], found[1, 3], np.arctan2(found[1, 0], found[0, 0])
        return poses

    return match


def csm() -> Matcher:
    """Return CSM's point-to-line ICP."""
    source, gsl = os.environ.get("CSM", ""), os.environ.get("GSL", "")
    code, outside = "sm_icp(&params, &result)", "CSM, 1 thread"
    if not source:
        return Matcher("csm", code, outside, None, "not compiled: CSM must name a copy of its sources")
    _kept.append(tempfile.TemporaryDirectory())
    try:
        place = Path(gsl) if gsl else None
        library = ctypes.CDLL(str(chaining_peers.build(Path(source), place, Path(_kept[-1].name), shared=True)))
    except (OSError, subprocess.CalledProcessError) as error:
        return Matcher("csm", code, outside, None, f"not compiled: {' '.join(str(error).split())[:200]}")
    return Matcher("csm", code, outside, _csm_match(library))


def _csm_match(library: ctypes.CDLL) -> Match:
    def match(first: np.ndarray, second: np.ndarray, scanner: gs.Scanner, guesses: np.ndarray) -> np.ndarray:
        def given(array: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(array, np.float64)

        def hits(ranges: np.ndarray) -> np.ndarray:
            hit = (ranges > max(scanner.range_min, 0.01)) & (ranges < scanner.range_max)
            return given(np.where(hit, ranges, np.nan))

        parts = [given(scanner.bearings), hits(first), hits(second), given(guesses)]
        found = np.empty((len(first), 4))
        library.pairs(scanner.count, len(first), *(ctypes.c_void_p(part.ctypes.data) for part in (*parts, found)))
        return np.where(found[:, :1] > 0, found[:, 1:], np.nan)

    return match


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
