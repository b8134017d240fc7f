"""Run ``gpusense demo``: score a noisy scan in a generated building at many poses, on every device, and draw it."""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import gpusense as gs
from gpusense._util.extras import check_library
from gpusense._util.files import check_writable
from gpusense._util.typing import Precision
from gpusense.commands import output
from gpusense.commands.arguments import BACKEND_HELP, Options, open_backends, picture, whole_number
from gpusense.commands.output import grouped, machine
from gpusense.commands.signals import working

if TYPE_CHECKING:
    from gpusense.backends import Backend, Selection

    Model = gs.BeamModel | gs.LikelihoodFieldModel

FIRST = ("particles", "backend", "output")
SHARED = ("seed", "verbose")
CODES = {1: "a device failed (the report has its error)"}

DESCRIPTION = """\
Generate a building and a noisy laser scan in it, and compute for many poses how likely the scan is: log P(z | x, m)
by the beam model and by the likelihood field. Every backend present does the same work; a table compares their times,
their errors against the float64 NumPy reference and their ranks of the true pose. A picture shows the building, the
scan at the best pose, the particles and the likelihood over the whole map."""

EPILOG = """\
examples:
  gpusense demo
  gpusense demo --particles 1000000 --backend opencl --backend warp:cuda:0
  gpusense demo --no-plot --json > demo.json"""

SIZE, BEAMS, FIELD_OF_VIEW, RANGE_MAX, SIGMA_XY, SIGMA_THETA = (30.0, 20.0), 180, 270.0, 15.0, 0.5, 0.3
BEAM, FIELD = "beam model", "likelihood field"
PRECISION: Precision = "float32"
# Most particles of the NumPy reference; total time of repeated calls [s]; most repeated calls.
REFERENCE_PARTICLES, PATIENCE, REPETITIONS = 500, 0.1, 3
# Distance between poses of the pictures [m]; most particles drawn.
LATTICE, DRAWN_PARTICLES = 0.1, 20_000
NOTE = "Generated building; scan drawn from the beam model's mixture. Colour scales end at the median of the values."


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--particles N", "poses to score: half around the true one, half over the whole building",
        whole_number(low=1, high=100_000_000), 100_000)  # fmt: skip
    add("--beams K", f"number of the scan's {BEAMS} beams that the models use", whole_number(low=1, high=BEAMS), 60)
    add("--backend DEVICE*", f"{BACKEND_HELP}; may be repeated to compare devices (default: every device present)")
    add("--output FILE", "file of the picture", picture, Path("gpusense-demo.png"))
    add("--no-plot", "draw no picture")


def run(args: argparse.Namespace) -> int:
    """Make the scene, score it on every device, report and draw; after Ctrl-C report the scores so far."""
    if not args.no_plot:
        check_library("matplotlib", "the picture, which --no-plot leaves out,")
        check_writable(args.output)
    marks = [("devices, scene and references", time.perf_counter())]
    # Children prove new devices, so this process has time for the rest.
    with ThreadPoolExecutor(1) as other:
        prepared = other.submit(_prepare, args)
        backends, failures = open_backends(args.backend)
        scene, references = prepared.result()
    scores: list[Score] = []
    written = None
    with working(scores, 2 * len(backends) + 1) as shown:

        def step(name: str) -> None:
            marks.append((name, time.perf_counter()))
            shown(name)

        _score_all(scene, references, backends, scores, failures, selected=args.backend is not None, step=step)
        step("picture")
        if not args.no_plot and {score.facts["model"] for score in scores} == {BEAM, FIELD}:
            draw(scene, scores, args.output)
            written = args.output
    marks.append(("report", time.perf_counter()))
    seconds = {name: end - begin for (name, begin), (_, end) in itertools.pairwise(marks)}
    if args.json:
        output.document(_document(scene, args.seed, scores, failures, written) | {"seconds": seconds})
    else:
        _report(scene, scores, failures, written)
    output.details(args, "Seconds: " + ", ".join(f"{name} {spent:.2f}" for name, spent in seconds.items()))
    return 1 if failures else 0


def _prepare(args: argparse.Namespace) -> tuple[Scene, dict[str, np.ndarray]]:
    """Make the scene and its float64 log-likelihoods by model, and import the plots."""
    scene = make_scene(args.seed, args.particles, args.beams)
    references = {}
    for name in (BEAM, FIELD):
        truth = make_model(scene, name, "numpy", "float64")
        references[name] = np.asarray(truth.log_likelihood(scene.poses[:-1][scene.checked], scene.ranges))
    if not args.no_plot:
        from gpusense import plots

        plots.new_figure(1.0, 1.0)
    return scene, references


def _score_all(
    scene: Scene, references: dict[str, np.ndarray], backends: list[Backend], scores: list[Score],
    failures: list[str], *, selected: bool, step: Callable[[str], None],
) -> None:  # fmt: skip
    """Score the scene with both models on all backends; append scores, and errors of unselected backends."""
    for name in (BEAM, FIELD):
        for backend in backends:
            step(f"{name} on {backend.info.selection}")
            try:
                scores.append(score_scene(scene, name, backend, references[name]))
            except Exception as error:
                if selected:
                    raise
                failures.append(f"{backend.info.selection}: {name}: {type(error).__name__}: {error}")


def draw(scene: Scene, scores: list[Score], path: Path) -> None:
    """Draw the scan at the best pose, the particles, and P(z | x, m) at the best heading by both models."""
    from gpusense.plots import drawing, pose_densities

    beam = _fastest(scores, BEAM)
    best = beam.facts["best_pose"]
    poses, free, extent = pose_densities.pose_lattice(scene.grid, LATTICE, float(best[2]))
    densities = {}
    for name in (BEAM, FIELD):
        density = np.full(free.shape, np.nan)
        density[free] = _fastest(scores, name).model.log_likelihood(poses[free.ravel()], scene.ranges)
        densities[f"{name.capitalize()}: every position at the best heading; ring: the truth"] = density
    shown = slice(None, None, -(-len(scene.poses) // DRAWN_PARTICLES))
    figure = pose_densities.localization_figure(
        scene.grid, scene.scanner, scene.ranges, scene.truth, best, beam.poses[:-1][shown], beam.log_p[:-1][shown],
        densities, extent,
    )  # fmt: skip
    title = f"Where is the robot?   P(z | x, m) of one scan, {scene.beams} of its {BEAMS} beams, by gpusense"
    figure.suptitle(title, fontsize=15)
    figure.supxlabel(NOTE, fontsize=9, color="#52606d")
    drawing.save(figure, path)


def _fastest(scores: list[Score], name: str) -> Score:
    rated = (score for score in scores if score.facts["model"] == name)
    return max(rated, key=lambda score: float(score.facts["particle_beams_per_s"]))


def _report(scene: Scene, scores: list[Score], failures: list[str], written: Path | None) -> None:
    """Print the likeliest pose, the table of devices, and the file of the picture."""
    rows = [score.facts for score in scores]
    count = grouped(len(scene.poses) - 1)
    for name in dict.fromkeys(row["model"] for row in rows):
        best = _fastest(scores, name).facts
        off = f"{best['best_pose_off_m']:.2f} m and {best['best_pose_off_degrees']:.1f} degrees off the true pose"
        output.result(f"{name.capitalize()}: the likeliest of {count} poses is {off}.")
    columns = ["backend", "model", "first call [s]", "next call [s]", "rate [M/s]", "error"]
    print()
    output.table(columns, [
        [row["backend"], row["model"], f"{row['first_call_s']:.2f}", f"{row['steady_s']:.3f}",
         f"{rate:.{int(rate <= 10)}f}", f"{row['largest_error']:.0e}"]
        for row, rate in ((row, row["particle_beams_per_s"] / 1e6) for row in rows)
    ], right=columns[2:])  # fmt: skip
    print()
    output.fact("rate", "particle-beams a second of whole calls, NumPy arrays in and out")
    output.fact("error", "of log p [nats], the largest at the poses that the NumPy reference scores in float64, one in "
                f"{scene.checked.step}")  # fmt: skip
    for failure in failures:
        output.fact("failed", failure)
    output.files(written)


def _document(
    scene: Scene, seed: int, scores: list[Score], failures: list[str], written: Path | None
) -> dict[str, Any]:
    """Build the report for ``--json``; times in seconds, errors in nats."""
    return {
        "machine": machine(), "seed": seed,
        "world": {"size_m": SIZE, "shape": scene.grid.shape, "resolution_m": scene.grid.resolution},
        "scan": {"beams": BEAMS, "beams_used": scene.beams, "range_max_m": RANGE_MAX, "ranges_m": scene.ranges},
        "particles": len(scene.poses) - 1, "true_pose": scene.truth, "results": [score.facts for score in scores],
        "failures": failures, "picture": written,
    }  # fmt: skip


# ---- the scene, its models, and their scores


class Scene(NamedTuple):
    """A map, a scan, the poses to score with the true pose last, and the number of beams for models."""

    grid: gs.OccupancyGrid
    scanner: gs.Scanner
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


class Score(NamedTuple):
    """A model on a device with the scores of poses, the true pose last, and the facts of the report."""

    model: Model
    poses: np.ndarray
    log_p: np.ndarray
    facts: dict[str, Any]


def make_world(seed: int) -> tuple[gs.OccupancyGrid, gs.Scanner]:
    """Make a building and a scanner."""
    first, step = -math.radians(FIELD_OF_VIEW) / 2, math.radians(FIELD_OF_VIEW) / (BEAMS - 1)
    scanner = gs.Scanner.uniform(angle_min=first, angle_increment=step, count=BEAMS, range_max=RANGE_MAX)
    return gs.worlds.building(seed, SIZE), scanner


def make_scene(seed: int, particles: int, beams: int) -> Scene:
    """Make a building, a scan drawn from the beam model at a free pose, and a cloud of particles."""
    rng = np.random.default_rng(seed)
    grid, scanner = make_world(seed)
    truth = gs.worlds.free_pose(grid, rng)
    ranges = gs.worlds.simulate_scan(grid, scanner, truth, gs.BeamParameters(), rng)
    around = gs.worlds.cloud_around(truth, particles // 2, SIGMA_XY, SIGMA_THETA, rng)
    anywhere = gs.worlds.cloud_uniform(grid, particles - particles // 2, rng)
    return Scene(grid, scanner, ranges, np.concatenate([around, anywhere, truth[None]]), beams)


def make_model(scene: Scene, name: str, backend: Selection, precision: Precision = PRECISION) -> Model:
    """Make a model with its default parameters; ``name`` is ``BEAM`` or ``FIELD``."""
    kind: Any = gs.BeamModel if name == BEAM else gs.LikelihoodFieldModel
    return kind(scene.grid, scene.scanner, backend=backend, precision=precision, beams=scene.beams)


def score_scene(scene: Scene, name: str, backend: Backend, reference: np.ndarray) -> Score:
    """Time the first call, model included, and up to ``REPETITIONS`` steady calls within ``PATIENCE`` seconds.

    NumPy scores the poses ``scene.checked`` and the true pose.
    """
    from gpusense.evaluation.scoring import evaluated_beams

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
    evaluated, device, others = evaluated_beams(model, scene.ranges), model.device, log_p[:-1]
    errors = np.abs((others if on_numpy else others[scene.checked]) - reference)
    best = poses[others.argmax()]
    dx, dy, turn = (best - scene.truth).tolist()
    return Score(model, poses, log_p, {
        "backend": device.selection, "device": device.name, "kind": device.kind, "driver": device.driver,
        "model": name, "precision": model.precision, "first_call_s": first, "steady_s": min(calls),
        "repetitions": len(calls), "beams_evaluated": evaluated,
        "particle_beams_per_s": len(log_p) * evaluated / min(calls), "largest_error": errors.max(),
        "error_poses": len(errors), "rank_of_true_pose": 1 + int((others > log_p[-1]).sum()),
        "log_p_of_true_pose": log_p[-1], "poses": len(others), "best_log_p": others.max(), "best_pose": best,
        "best_pose_off_m": math.hypot(dx, dy),
        "best_pose_off_degrees": abs(math.degrees(math.remainder(turn, math.tau))), "explain": model.explain(),
    })  # fmt: skip
