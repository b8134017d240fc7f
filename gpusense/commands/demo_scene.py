"""Make the scene of ``gpusense demo``, and score and time its models."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util.typing import Precision
from gpusense.backends import Backend, Selection
from gpusense.evaluation import worlds
from gpusense.evaluation.scoring import evaluated_beams
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters
from gpusense.world.scanner import Scanner

SIZE, BEAMS, FIELD_OF_VIEW, RANGE_MAX, SIGMA_XY, SIGMA_THETA = (30.0, 20.0), 180, 270.0, 15.0, 0.5, 0.3
BEAM, FIELD = "beam model", "likelihood field"
PRECISION: Precision = "float32"
# Most particles of the NumPy reference; total time of repeated calls [s]; most repeated calls.
REFERENCE_PARTICLES, PATIENCE, REPETITIONS = 500, 0.2, 3

Model = BeamModel | LikelihoodFieldModel


@dataclass(frozen=True)
class Scene:
    """A map, a scan, the poses to score with the true pose last, and the number of beams for models."""

    grid: OccupancyGrid
    scanner: Scanner
    ranges: np.ndarray
    poses: np.ndarray
    beams: int

    @property
    def truth(self) -> np.ndarray:
        """Return (3,) the true pose [m, m, rad]."""
        return self.poses[-1]

    @property
    def checked(self) -> slice:
        """Return the slice of poses that NumPy also scores."""
        return slice(None, None, -(-len(self.poses) // REFERENCE_PARTICLES))


@dataclass(frozen=True)
class Score:
    """Scores and times of a model on a device; the true pose is last."""

    name: str
    model: Model
    poses: np.ndarray
    log_p: np.ndarray
    first_s: float
    steady_s: float
    repetitions: int
    evaluated: int
    errors: np.ndarray

    @property
    def rate(self) -> float:
        """Return the particle-beams per second of the steady call."""
        return len(self.log_p) * self.evaluated / self.steady_s

    @property
    def rank(self) -> int:
        """Return the rank of the true pose: 1 if no particle scores better."""
        return 1 + int((self.log_p[:-1] > self.log_p[-1]).sum())

    @property
    def best(self) -> np.ndarray:
        """Return the likeliest particle (3,)."""
        return self.poses[self.log_p[:-1].argmax()]

    @property
    def off(self) -> tuple[float, float]:
        """Return the distance of the likeliest particle from the true pose [m, degrees]."""
        dx, dy, turn = (self.best - self.poses[-1]).tolist()
        return math.hypot(dx, dy), abs(math.degrees(math.remainder(turn, math.tau)))


def make_world(seed: int) -> tuple[OccupancyGrid, Scanner]:
    """Make a building and a scanner."""
    first, step = -math.radians(FIELD_OF_VIEW) / 2, math.radians(FIELD_OF_VIEW) / (BEAMS - 1)
    scanner = Scanner.uniform(angle_min=first, angle_increment=step, count=BEAMS, range_max=RANGE_MAX)
    return worlds.building(seed, SIZE), scanner


def make_scene(seed: int, particles: int, beams: int) -> Scene:
    """Make a building, a scan drawn from the beam model at a free pose, and a cloud of particles."""
    rng = np.random.default_rng(seed)
    grid, scanner = make_world(seed)
    truth = worlds.free_pose(grid, rng)
    ranges = worlds.simulate_scan(grid, scanner, truth, BeamParameters(), rng)
    around = worlds.cloud_around(truth, particles // 2, SIGMA_XY, SIGMA_THETA, rng)
    anywhere = worlds.cloud_uniform(grid, particles - particles // 2, rng)
    return Scene(grid, scanner, ranges, np.concatenate([around, anywhere, truth[None]]), beams)


def make_model(scene: Scene, name: str, backend: Selection, precision: Precision = PRECISION) -> Model:
    """Make a model with its default parameters; ``name`` is ``BEAM`` or ``FIELD``."""
    kind: Any = BeamModel if name == BEAM else LikelihoodFieldModel
    return kind(scene.grid, scene.scanner, backend=backend, precision=precision, beams=scene.beams)


def score_scene(scene: Scene, name: str, backend: Backend, reference: np.ndarray) -> Score:
    """Time the first call, model included, and up to ``REPETITIONS`` steady calls within ``PATIENCE`` seconds.

    NumPy scores the poses ``scene.checked`` and the true pose.
    """
    on_numpy = backend.info.backend == "numpy"
    poses = np.concatenate([scene.poses[:-1][scene.checked], scene.poses[-1:]]) if on_numpy else scene.poses
    begin = time.perf_counter()
    model = make_model(scene, name, backend)
    log_p = np.asarray(model.log_likelihood(poses, scene.ranges))
    first = time.perf_counter() - begin
    calls: list[float] = []
    while len(calls) < REPETITIONS and sum(calls) < PATIENCE:
        begin = time.perf_counter()
        log_p = np.asarray(model.log_likelihood(poses, scene.ranges))
        calls.append(time.perf_counter() - begin)
    # Readings without return have the same probability at every pose, and are not evaluated.
    evaluated = evaluated_beams(model, scene.ranges)
    scored = log_p[:-1] if on_numpy else log_p[:-1][scene.checked]
    errors = np.abs(scored - reference)
    return Score(name, model, poses, log_p, first, min(calls), len(calls), evaluated, errors)
