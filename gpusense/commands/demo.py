"""``gpusense demo``: a noisy scan in a made-up building, scored at many poses on everything that is here, and drawn."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpusense import plots
from gpusense._util.progress import progress
from gpusense.backends import Backend, Selection
from gpusense.commands import common
from gpusense.commands.common import grouped
from gpusense.evaluation import worlds
from gpusense.evaluation.scoring import evaluated_beams
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters
from gpusense.world.scanner import Scanner

NAME = "demo"
HELP = "Localise a robot in a made-up building with every backend, compare them, and draw the result."

_DESCRIPTION = """\
Makes a building and a noisy laser scan in it, and asks for many poses how likely the scan would be there:
log P(z | x, m) by the beam model and by the likelihood field. Every backend found here does the same work; a table
compares their times, their distance from the float64 NumPy reference and where they rank the true pose. A picture
shows the building, the scan at the best pose, the particles and the likelihood all over the map."""

_EPILOG = """\
examples:
  gpusense demo
  gpusense demo --particles 1000000 --backend opencl --backend warp:cuda:0
  gpusense demo --no-plot --json > demo.json

Exit codes: 0 success, 1 a device that was found failed (the report says how), 2 bad input."""

SIZE, BEAMS, FIELD_OF_VIEW, RANGE_MAX, SIGMA_XY, SIGMA_THETA = (30.0, 20.0), 180, 270.0, 15.0, 0.5, 0.3
BEAM, FIELD = "beam model", "likelihood field"
PRECISION, LATTICE = "float32", 0.1
# The reference scores so many particles at most; repeated calls share so many seconds.
REFERENCE_PARTICLES, PATIENCE, REPETITIONS = 10_000, 4.0, 3
NOTE = "Made-up building; scan drawn from the beam model's own mixture. Colour scales end at the median of the values."


Model = BeamModel | LikelihoodFieldModel


@dataclass(frozen=True)
class Scene:
    """What is asked: the world, a scan in it, and the poses to score; the last pose is the true one."""

    grid: OccupancyGrid
    scanner: Scanner
    ranges: np.ndarray
    poses: np.ndarray
    beams: int

    @property
    def truth(self) -> np.ndarray:
        """(3,) where the robot is."""
        return self.poses[-1]

    @property
    def checked(self) -> slice:
        """The poses that the float64 reference scores as well."""
        return slice(None, None, -(-len(self.poses) // REFERENCE_PARTICLES))


@dataclass(frozen=True)
class Score:
    """What one model on one device made of a scene."""

    name: str
    model: Model
    log_p: np.ndarray
    first_s: float
    steady_s: float
    repetitions: int
    evaluated: int
    errors: np.ndarray

    @property
    def rate(self) -> float:
        """Particle-beams per second of the steady call."""
        return len(self.log_p) * self.evaluated / self.steady_s

    @property
    def rank(self) -> int:
        """The rank of the true pose: 1 if no particle scores better."""
        return 1 + int((self.log_p[:-1] > self.log_p[-1]).sum())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.description, parser.epilog = _DESCRIPTION, _EPILOG
    parser.add_argument(
        "--particles", type=common.whole_number(low=1, high=100_000_000), default=100_000, metavar="N",
        help="poses to score: half around the true one, half all over the building (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--beams", type=common.whole_number(low=1, high=BEAMS), default=60, metavar="K",
        help=f"how many of the scan's {BEAMS} beams the models use (default: %(default)s)",
    )  # fmt: skip
    common.add_seed(parser)
    parser.add_argument(
        "--backend", action="append", metavar="DEVICE",
        help=f"{common.BACKEND_HELP}; give it again to compare several (default: every device found here)",
    )  # fmt: skip
    parser.add_argument(
        "--output", type=common.output_path(".png", ".pdf", ".svg"), default=Path("gpusense-demo.png"),
        metavar="FILE", help="the picture (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--no-plot", action="store_true", help="draw no picture")
    common.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Make the scene, score it everywhere, report and draw."""
    if not args.no_plot:
        common.check_writable(args.output)
    backends, failures = common.open_backends(args.backend)
    scene = make_scene(args.seed, args.particles, args.beams)
    if not args.json:
        _introduce(scene, args.seed, backends)
    scores: list[Score] = []
    with progress(2 * len(backends) + 3) as step:
        for name in (BEAM, FIELD):
            step(f"{name}, float64 reference")
            truth = make_model(scene, name, "numpy", "float64")
            reference = np.asarray(truth.log_likelihood(scene.poses[scene.checked], scene.ranges))
            for backend in backends:
                step(f"{name} on {backend.info.selection}")
                try:
                    scores.append(score(scene, name, backend, reference))
                except Exception as error:
                    if args.backend is not None:
                        raise
                    failures.append(f"{backend.info.selection}: {name}: {type(error).__name__}: {error}")
        step("picture")
        drawn = not args.no_plot and {one.name for one in scores} == {BEAM, FIELD}
        if drawn:
            draw(scene, scores, args.output)
    written = args.output if drawn else None
    if args.json:
        common.print_json(_document(scene, args.seed, scores, failures, written))
    else:
        _report(scene, scores, failures, written)
    return 1 if failures else 0


def make_scene(seed: int, particles: int, beams: int) -> Scene:
    """A building, a scan drawn from the beam model at a free pose, and a cloud of particles."""
    rng = np.random.default_rng(seed)
    grid = worlds.building(seed, SIZE)
    first, step = -math.radians(FIELD_OF_VIEW) / 2, math.radians(FIELD_OF_VIEW) / (BEAMS - 1)
    scanner = Scanner.uniform(angle_min=first, angle_increment=step, count=BEAMS, range_max=RANGE_MAX)
    truth = worlds.free_pose(grid, rng)
    ranges = worlds.simulate_scan(grid, scanner, truth, BeamParameters(), rng)
    around = worlds.cloud_around(truth, particles // 2, SIGMA_XY, SIGMA_THETA, rng)
    anywhere = worlds.cloud_uniform(grid, particles - particles // 2, rng)
    return Scene(grid, scanner, ranges, np.concatenate([around, anywhere, truth[None]]), beams)


def make_model(scene: Scene, name: str, backend: Selection, precision: str = PRECISION) -> Model:
    """The model of that name with its default parameters."""
    kind: Any = BeamModel if name == BEAM else LikelihoodFieldModel
    return kind(scene.grid, scene.scanner, backend=backend, precision=precision, beams=scene.beams)


def score(scene: Scene, name: str, backend: Backend, reference: np.ndarray) -> Score:
    """Score the scene once from nothing, and then again as often as patience allows."""
    begin = time.perf_counter()
    model = make_model(scene, name, backend)
    log_p = np.asarray(model.log_likelihood(scene.poses, scene.ranges))
    first = time.perf_counter() - begin
    calls: list[float] = []
    slow = backend.info.backend == "numpy" and first > PATIENCE
    while not slow and len(calls) < REPETITIONS and sum(calls) < PATIENCE:
        begin = time.perf_counter()
        log_p = np.asarray(model.log_likelihood(scene.poses, scene.ranges))
        calls.append(time.perf_counter() - begin)
    # A reading without return has the same probability at every pose, and nothing is evaluated for it.
    evaluated = evaluated_beams(model, scene.ranges)
    errors = np.abs(log_p[scene.checked] - reference)
    return Score(name, model, log_p, first, min(calls, default=first), len(calls), evaluated, errors)


def draw(scene: Scene, scores: list[Score], path: Path) -> None:
    """The picture: the scan at the best pose, the particles, and P(z | x, m) at the best heading by both models."""
    beam = _fastest(scores, BEAM)
    best = scene.poses[beam.log_p[:-1].argmax()]
    poses, free, extent = plots.pose_lattice(scene.grid, LATTICE, float(best[2]))
    densities = {}
    for name in (BEAM, FIELD):
        density = np.full(free.shape, np.nan)
        density[free] = _fastest(scores, name).model.log_likelihood(poses[free.ravel()], scene.ranges)
        densities[f"{name.capitalize()}: every position at the best heading; ring: the truth"] = density
    figure = plots.localization_figure(
        scene.grid, scene.scanner, scene.ranges, scene.truth, best, scene.poses[:-1], beam.log_p[:-1], densities, extent
    )
    title = f"Where is the robot?   P(z | x, m) of one scan, {scene.beams} of its {BEAMS} beams, by gpusense"
    figure.suptitle(title, fontsize=15)
    figure.supxlabel(NOTE, fontsize=9, color="#52606d")
    plots.save(figure, path)


def _fastest(scores: list[Score], name: str) -> Score:
    return max((score for score in scores if score.name == name), key=lambda score: score.rate)


def _introduce(scene: Scene, seed: int, backends: list[Backend]) -> None:
    rows, cols = scene.grid.shape
    hits = int((scene.ranges < RANGE_MAX).sum())
    print(f"""Where is the robot?
  building   {SIZE[0]:g} x {SIZE[1]:g} m, {cols} x {rows} cells of {scene.grid.resolution:g} m, seed {seed}
  scan       {BEAMS} beams over {FIELD_OF_VIEW:g} degrees up to {RANGE_MAX:g} m, drawn from the beam model:
             {hits} ranges, {BEAMS - hits} without return
  particles  {grouped(len(scene.poses) - 1)}: half over all free cells, half around the true pose
             (standard deviations {SIGMA_XY:g} m and {SIGMA_THETA:g} rad)
  models     {scene.beams} of the beams, {PRECISION}, default parameters
  devices    {", ".join(f"{backend.info.selection} ({backend.info.name})" for backend in backends)}
""", flush=True)  # fmt: skip


def _report(scene: Scene, scores: list[Score], failures: list[str], written: Path | None) -> None:
    columns = ["backend", "model", "first [s]", "steady [s]", "rate [M/s]", "error", "rank"]
    rows = []
    for one in scores:
        steady = f"{one.steady_s:.3f}" if one.repetitions else "-"
        figures = [f"{one.first_s:.3f}", steady, f"{one.rate / 1e6:.1f}", f"{one.errors.max():.0e}", grouped(one.rank)]
        rows.append([one.model.device.selection, one.name, *figures])
    common.print_table(columns, rows, right=columns[2:])
    every = f"{scene.checked.step}th pose".removeprefix("1th ")
    print(f"""
first   the first call: constructor, compilation (or its cache on disk), map preparation, scoring
steady  best of up to {REPETITIONS} more, transfers included; NumPy gets none if its first took over {PATIENCE:g} s
rate    millions of particle-beams per second of a steady call; a beam without return costs nothing and does not count
error   largest error of log p [nats] against the NumPy reference in float64, at every {every}
rank    of the true pose: 1 if no particle scores better""")
    for name in dict.fromkeys(one.name for one in scores):
        metres, degrees = _offset(scene, fastest := _fastest(scores, name))
        print(f"\nThe best particle by the {name} is {metres:.2f} m and {degrees:.1f} degrees off the true pose.")
        if name == FIELD and metres > SIGMA_XY:
            print("It ignores what stands between the robot and an end point, so similar places can score alike.")
        print(f"What was left out and why: {fastest.model.explain()}")
    print("".join(f"\nfailed: {failure}\n" for failure in failures), end="")
    if written is not None:
        print(f"\nPicture: {written}")


def _offset(scene: Scene, one: Score) -> tuple[float, float]:
    """How far the best particle is from the true pose [m, degrees]."""
    dx, dy, turn = (scene.poses[one.log_p[:-1].argmax()] - scene.truth).tolist()
    return math.hypot(dx, dy), abs(math.degrees(math.remainder(turn, math.tau)))


def _document(
    scene: Scene, seed: int, scores: list[Score], failures: list[str], written: Path | None
) -> dict[str, Any]:
    """The report for machines; times in seconds, errors in nats."""
    results = []
    for one in scores:
        device = one.model.device
        metres, degrees = _offset(scene, one)
        results.append({
            "backend": device.selection, "device": device.name, "kind": device.kind, "driver": device.driver,
            "model": one.name, "precision": one.model.precision, "first_call_s": one.first_s,
            "steady_s": one.steady_s, "repetitions": one.repetitions, "beams_evaluated": one.evaluated,
            "particle_beams_per_s": one.rate, "largest_error": one.errors.max(), "error_poses": len(one.errors),
            "rank_of_true_pose": one.rank, "log_p_of_true_pose": one.log_p[-1], "best_log_p": one.log_p[:-1].max(),
            "best_pose": scene.poses[one.log_p[:-1].argmax()], "best_pose_off_m": metres,
            "best_pose_off_degrees": degrees, "explain": one.model.explain(),
        })  # fmt: skip
    return {
        "machine": common.machine(),
        "seed": seed,
        "world": {"size_m": SIZE, "shape": scene.grid.shape, "resolution_m": scene.grid.resolution},
        "scan": {"beams": BEAMS, "beams_used": scene.beams, "range_max_m": RANGE_MAX, "ranges_m": scene.ranges},
        "particles": len(scene.poses) - 1,
        "true_pose": scene.truth,
        "results": results,
        "failures": failures,
        "picture": written,
    }
