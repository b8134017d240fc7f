"""Prove a device: compute a small scene with each family of kernels and compare with NumPy.

The scene is ordinary, so the proof compiles the kernels of the first call with a scan.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gpusense.backends import Backend, get_backend, open_device, set_up_child
from gpusense.backends.proof import FLOAT64, SCALAR, VECTORS, info_of
from gpusense.evaluation.tolerances import TOLERANCES, Tolerance, scan_tolerance
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.distances import distance_transform
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner
from gpusense.world.windows import LONGEST_SIDE

Report = Callable[[dict[str, Any]], None]
_BEAMS = 24
_POSES = 70
# Number of poses and seconds of the timed calls.
_TIMED_POSES = 4000
_TIMED_SECONDS = 0.02


class Scene:
    """A room with pillars and an unknown corner, a scan, and poses, some of them in walls."""

    def __init__(self) -> None:
        random = np.random.default_rng(0)
        cells = np.zeros((40, 57), np.int8)
        cells[[0, -1]] = cells[:, [0, -1]] = 100
        cells[random.integers(1, 39, 25), random.integers(1, 56, 25)] = 100
        cells[30:, 40:] = -1
        # A room, and a line that takes a processor's kernels loops of more than 65 535 steps.
        self.obstacles = [cells == 100, np.zeros((1, LONGEST_SIDE), bool)]
        self.obstacles[1][0, ::64] = True
        self.grid = OccupancyGrid(cells, resolution=0.1)
        self.scanner = Scanner.uniform(angle_min=-3.0, angle_increment=6.0 / (_BEAMS - 1), count=_BEAMS, range_max=4.5)
        self.poses = random.uniform((0.3, 0.3, -3.2), (5.4, 3.7, 3.2), (_POSES, 3))
        self.ranges = random.uniform(0.1, 4.4, _BEAMS)
        self.ranges[[3, 9, 10]] = 4.5, np.nan, np.inf


def prove(job: dict[str, Any], report: Report) -> None:
    """Run each family of kernels that a device has; stop at the first that computes wrong numbers."""
    info = info_of(job)
    if "setup" in job:
        set_up_child(info.backend, job["setup"])
    scene, numpy = Scene(), get_backend("numpy")
    report({"begin": SCALAR})
    device = open_device(info)
    models = VECTORS if info.lanes > 1 else SCALAR
    # Poses are placed in float64 if a device has it, even for float32 models.
    checks = [(SCALAR, _tables), *([(FLOAT64, _float64)] if info.float64 else []), (models, _models)]
    for family, check in checks:
        report({"begin": family})
        if wrong := check(scene, device, numpy):
            report({"wrong": wrong})
            return
    report({"rate": _rate(scene, device)})
    report({"end": True})


def _tables(scene: Scene, device: Backend, numpy: Backend) -> str:
    """Compare distance transforms; their kernels have no lanes."""
    for cells in scene.obstacles:
        distances = [distance_transform(cells, squared=True, backend=backend) for backend in (device, numpy)]
        if wrong := _difference(TOLERANCES["distance transform"], *distances):
            return f"{cells.shape[0]} x {cells.shape[1]} cells, {wrong}"
    return ""


def _models(scene: Scene, device: Backend, numpy: Backend) -> str:
    """Compare the scores of both scan models in float32; the beam model's scores include its ray casting."""
    tolerance = scan_tolerance("float32", _BEAMS).twice()
    for kind in (LikelihoodFieldModel, BeamModel):
        models = [kind(scene.grid, scene.scanner, backend=backend) for backend in (device, numpy)]
        scores = [model.log_likelihood(scene.poses, scene.ranges) for model in models]
        if wrong := _difference(tolerance, *scores):
            return f"{kind.__name__}, {wrong}"
    return ""


def _rate(scene: Scene, device: Backend) -> float:
    """Return the scans per second that the device scores: the geometric mean over both models of their best call."""
    poses = np.resize(scene.poses, (_TIMED_POSES, 3))
    best = []
    for kind in (LikelihoodFieldModel, BeamModel):
        model = kind(scene.grid, scene.scanner, backend=device)
        model.log_likelihood(poses, scene.ranges)
        seconds: list[float] = []
        end = time.perf_counter() + _TIMED_SECONDS
        while len(seconds) < 3 or time.perf_counter() < end:
            begin = time.perf_counter()
            model.log_likelihood(poses, scene.ranges)
            seconds.append(time.perf_counter() - begin)
        best.append(min(seconds))
    return 1 / math.sqrt(best[0] * best[1])


def _float64(scene: Scene, device: Backend, numpy: Backend) -> str:
    """Compare ranges in float64."""
    angles = scene.scanner.bearings
    ranges = [
        RayCaster(scene.grid, scene.scanner.range_max, precision="float64", backend=backend).cast(scene.poses, angles)
        for backend in (device, numpy)
    ]
    return _difference(TOLERANCES["float64 ranges"].twice(), *ranges)


def _difference(tolerance: Tolerance, computed: np.ndarray, expected: np.ndarray) -> str:
    """Describe the difference of results; return an empty string if the tolerance allows it."""
    difference = tolerance.difference(computed, expected)
    if difference <= tolerance.value:
        return ""
    return f"{tolerance.name}: {difference:.4g} {tolerance.unit}, allowed {tolerance.value:.3g}"
