"""Build the plan of a scan model, measure the cost of the parts that it leaves out, and read its kernels' text."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.plan import Omission, Plan, SceneNotes, share
from gpusense.interface.signatures import KERNELS
from gpusense.models.chunking import finish
from gpusense.models.scan.classed import ClassedScans, ModelContext
from gpusense.models.scan.pipeline import Request, ScanPipeline
from gpusense.models.scan.scoring import LastCall, run
from gpusense.world.grid import OccupancyGrid

# Number of particles, number of rounds in which the scene with and without a part alternate, and least time of a turn
# [s].
PARTICLES, ROUNDS, TURN = 2000, 7, 0.01
MakeRequest = Callable[[np.ndarray, np.ndarray], Request]


def measured_savings(
    make_request: MakeRequest, pipeline: ScanPipeline, last: LastCall, plan: Plan, beams: int
) -> dict[str, float]:
    """Return median differences [s] of a call with and without each part that flags bring back, by their names."""
    scan = last.scan
    if scan is None or not len(scan.readings) or not last.flags:
        raise RuntimeError("measure: must follow a call of log_likelihood with a reading that depends on the pose")
    request = make_request(poses_on(pipeline.grid)[None], ranges_of(scan, beams))
    savings = {}
    for omission in plan.omissions:
        if omission.flags or omission.ends & last.flags:
            with_part = (omission.flags, omission.ends)
            savings[omission.what] = _difference(pipeline, request, with_part)
    return savings


def poses_on(grid: OccupancyGrid) -> np.ndarray:
    """Draw (2000, 3) poses from the free cells of a map, or from all cells where none is free."""
    rng = np.random.default_rng(0)
    rows, cols = np.nonzero(grid.free if grid.free.any() else np.ones(grid.shape, bool))
    chosen = rng.integers(len(rows), size=PARTICLES)
    headings = rng.uniform(-np.pi, np.pi, PARTICLES)
    return np.column_stack([grid.cell_centers(rows[chosen], cols[chosen]), headings])


def ranges_of(scan: ClassedScans, beams: int) -> np.ndarray:
    """Return a classed scan as (1, K) ranges; readings that were left out are missing."""
    ranges = np.full((1, beams), np.nan)
    ranges[0, scan.columns] = scan.readings
    ranges[0, scan.left_out.constant_max] = np.inf
    return ranges


def _difference(pipeline: ScanPipeline, request: Request, with_part: tuple[frozenset[str], frozenset[str]]) -> float:
    """Return the extra time of a call with other flags of the scoring kernel [s], measured in turns."""
    spaces = [(Workspace(pipeline.backend), None), (Workspace(pipeline.backend), with_part)]

    def turn(which: int, calls: int) -> float:
        space, pipeline.trial = spaces[which]
        begin = time.perf_counter()
        try:
            for _ in range(calls):
                with space:
                    run(pipeline, request, space, LastCall())
                    finish(space, on_device=False)
        finally:
            pipeline.trial = None
        return (time.perf_counter() - begin) / calls

    for which in (0, 1):
        turn(which, 2)
    calls = max(1, round(TURN / max(turn(0, 1), 1e-6)))
    rounds = [turn(1, calls) - turn(0, calls) for _ in range(ROUNDS)]
    return float(np.median(rounds))


def sources_of(backend: Backend, last: LastCall) -> dict[str, str]:
    """Return the text of the kernels of a last call, by their names."""
    return {kernel: backend.source(kernel, last.flags) for kernel in last.kernels}


# ---- the plan of any scan model


def plan_of_call(notes: SceneNotes, context: ModelContext, last: LastCall) -> Plan:
    """Return the plan as of the last call."""
    device = context.backend.info
    title = f"{notes.title}, {device.selection} ({device.name})"
    if not context.rules.specialize:
        return Plan(f"{title}, specialize=False", last.flags, ())
    omissions = (*notes.omissions, *_arguments(last), *_launches(last), *_readings(last, context.rules.scanner.count))
    return Plan(title, last.flags, omissions, tuple(notes.kept), tuple(notes.could_go))


def _arguments(last: LastCall) -> list[Omission]:
    """Return the arguments that the kernels of the last call do not take."""
    rows = [KERNELS[kernel] for kernel in last.kernels]
    count = sum(len(row.arguments) for row in rows)
    absent = count - sum(len(row.with_flags(last.flags).arguments) for row in rows)
    if not absent:
        return []
    why = f"{absent} of {count} arguments belong to parts that are left out"
    return [Omission("kernel arguments", why, "their setting for each launch")]


def _launches(last: LastCall) -> list[Omission]:
    """Return the launches that scans share."""
    if last.together <= 1:
        return []
    saved = f"{last.together - 1} of {last.together} sets of launches"
    return [Omission("launches of single scans", f"{last.together} scans are scored together", saved)]


def _readings(last: LastCall, count: int) -> list[Omission]:
    """Return the readings of the last scan of ``count`` beams that are not evaluated; none before a call."""
    if last.scan is None:
        return []
    left_out = last.scan.left_out
    classes = (
        (left_out.missing, "missing readings", "say nothing"),
        (left_out.ignored_max, "max readings", "say nothing while z_max = 0"),
        (len(left_out.constant_max), "max readings", "have probability z_max at every pose"),
        (left_out.thinned, "thinned beams", "are not among those that beams= chose"),
    )
    return [
        Omission(what, f"{left} of {count} readings {why}", f"{share(left, count)} of the beams")
        for left, what, why in classes
        if left
    ]
