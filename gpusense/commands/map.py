"""Run ``gpusense map``: build an occupancy grid from a log, with logged poses or a chain of matches."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import gpusense as gs
from gpusense.chaining import chain as chaining
from gpusense.chaining import result as chain_result
from gpusense.commands import output
from gpusense.commands.arguments import Options, Output, csv_file, number, picture, positive_number, refuse, tum_file
from gpusense.commands.output import counted, draw, grouped, write_table
from gpusense.commands.scans import add_log, read_posed_steps, scanners_of, write_trajectory
from gpusense.commands.signals import working
from gpusense.evaluation import log_steps
from gpusense.mapping import build
from gpusense.world import images

if TYPE_CHECKING:
    from gpusense.evaluation.log_steps import Step

FIRST = ("log", "out", "plot", "chain", "resolution")
SHARED = ("reference", "choice", "backend", "verbose")

# Scans per step of the progress bar.
_SCANS = 64

EPILOG = """\
Each ray makes the cells that it crosses more likely free, and the cell where it ends more likely occupied. Cells
without a ray stay unknown. The map is map_server's YAML file and an image with white free, black occupied and grey
unknown cells; remove people and close gaps in an image editor.

Logs without corrected poses, such as bags, are chained: each scan is matched to the previous scan and to key scans
around it, revisited places are found and matched, and least squares over all matches and the odometry yields the poses.
The command reports closed loops and doubtful stretches. Poses in raw CARMEN logs are copies of the odometry: --chain
finds better poses. --reference takes the poses of a TUM trajectory. Several lasers of a bag, with mounts from its
transforms, make a common trajectory and map.
A chain begins at 0 0 0 of its map: 'gpusense localize' follows the same log from --start 0 0 0, others with --global.

Ctrl-C ends the chain and writes the map of the scans so far, or ends the map with some of the scans. A map of more than
four million cells is built in bands of rows; an interrupted one holds the finished bands, and some scans of the next.

examples:
  gpusense map --log run.bag --out map.yaml --tum run.tum --plot map.png
  gpusense localize --map map.yaml --log run.bag --start 0 0 0
  gpusense map --log run.bag --topic /front /rear --out map.yaml
  gpusense map --log run.log.gz --chain --range-limit 20 --out map.yaml
  gpusense map --log run.log.gz --every 2 --range-limit 20 --resolution 0.1 \\
      --out even.yaml
  gpusense map --log run.bag --reference run.tum --out map.yaml"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add_log(add, "a log with scans", several="lasers of the map")
    add("--chain", "find the poses by matching the scans and closing loops, even if the log has poses (default: if it "
        "has none)")  # fmt: skip
    add("--no-odometry", "chain the scans without the log's odometry")
    add("--no-loops", "do not search for revisited places")
    add("--tum FILE", "write the poses of a chain for evo", tum_file)
    add("--poses CSV", "write the poses of a chain with covariances and doubts", csv_file)
    add("--plot FILE", "draw the map with trajectory, closures and doubtful stretches of a chain", picture)
    add("--out YAML", "the map, next to its image", Output(".yaml"), required=True)
    add("--mode", "trinary: white, black and grey; scale: shades, a PNG; raw: per cent as greys, almost black",
        images.MODES, "trinary")  # fmt: skip
    add("--resolution M", "side of a cell [m]", positive_number, 0.05)
    add("--range-limit M", "longer ranges clear cells up to it and mark no obstacle [m] (default: none)",
        positive_number)  # fmt: skip
    add("--clear-max", "clear cells along 'no return' readings, up to --range-limit")
    add("--p-hit P", "occupancy after one hit", number, 0.85)
    add("--p-miss P", "occupancy after one miss", number, 0.45)


def run(args: argparse.Namespace) -> int:
    """Build and write the map; after Ctrl-C, the map of the scans so far."""
    if args.chain and args.reference is not None:
        raise ValueError("--chain: must not be used with --reference, which has the poses, got both")
    steps = read_posed_steps(args)
    chained, chosen = None, len(steps)
    if _is_chained(args, steps):
        chained = _chain_log(args, steps)
        steps = chained.steps
    scans = log_steps.with_poses(steps, args.log)
    builder = build.MapBuilder(
        [scan.ranges for _, scan in scans], [scan.pose or (0.0, 0.0, 0.0) for _, scan in scans],
        resolution=args.resolution, origin=None, shape=None, range_limit=args.range_limit, clear_max=args.clear_max,
        p_hit=args.p_hit, p_miss=args.p_miss, p_prior=0.5, occupied_threshold=65, backend=args.backend, each=_SCANS,
        motion=None if chained is None else chained.chain.motions, **scanners_of(steps),
    )  # fmt: skip
    done = 0.0
    with working((builder,), max(builder.parts, 1)) as step:
        for done in builder.steps():
            step(f"{100 * done:.0f}%")
    grid = builder.grid()
    image = _write(args, grid)
    if chained is not None:
        _write_chain(args, chained, grid)
    _report(args, builder, grid, image, (round(done * len(scans)), chosen), chained)
    return 0


def _write(args: argparse.Namespace, grid: gs.OccupancyGrid) -> Path:
    """Write the map, and return the path of its image."""
    transparent = args.mode == "scale" and bool(grid.unknown.any())
    form: Literal["pgm", "png"] = "png" if transparent else "pgm"
    gs.write_map(grid, args.out, mode=args.mode, image_format=form)
    image: Path = args.out.with_suffix(f".{form}")
    return image


def _report(
    args: argparse.Namespace, builder: build.MapBuilder, grid: gs.OccupancyGrid, image: Path, scans: tuple[int, int],
    chained: ChainedScans | None,
) -> None:  # fmt: skip
    """Print a summary of the map."""
    rows, cols = grid.shape
    free, occupied = int(grid.free.sum()), int(grid.occupied.sum())
    if args.json:
        output.report({
            "map": str(args.out), "image": str(image), "mode": args.mode, "scans": scans[0],
            "scans_chosen": scans[1], "rays": builder.rays, "rows": rows, "cols": cols,
            "resolution": grid.resolution, "origin": grid.origin, "free": free, "occupied": occupied,
            "chain": None if chained is None else _chain_document(args, chained),
        })  # fmt: skip
        return
    if chained is None:
        output.result(f"MAPPED: {counted(scans[0], 'scan')} at {'reference' if args.reference else 'logged'} poses")
    else:
        _print_chain(chained)
    size = f"{cols * grid.resolution:.0f} x {rows * grid.resolution:.0f} m, cells of {grid.resolution:g} m"
    output.fact("map", f"{size}: {grouped(occupied)} occupied, {grouped(free)} free")
    output.interrupted(*scans, "scans" if builder.bands == 1 else "scans' worth of rays")
    output.files(args.out, image, args.plot, args.tum, args.poses)
    start = " --start 0 0 0" if chained is not None else ""
    print(f"next       gpusense localize --map {args.out} --log {args.log}{start}")
    chain = "" if chained is None else f"{chained.chain.explain()}\nchained in {chained.seconds:.1f} s\n"
    output.details(args, f"{chain}{counted(builder.rays, 'ray')} of {counted(scans[0], 'scan')}, {rows} x {cols} cells")


# Steps of the progress bar during the search for loops.
_ROUNDS = 20
# Columns of the upper triangle of a covariance.
_COVARIANCES = ("var_x", "cov_xy", "cov_xtheta", "var_y", "cov_ytheta", "var_theta")


@dataclass
class ChainedScans:
    """Scans with poses from a chain."""

    steps: list[Step]
    chain: gs.ScanChain
    seconds: float


def _is_chained(args: argparse.Namespace, steps: list[Step]) -> bool:
    """Return whether a chain finds the poses, and check the options that need a chain."""
    chained = args.chain or (args.reference is None and any(step.scan.pose is None for step in steps))
    if not chained:
        of_chain = ("tum", "poses", "plot", "no_odometry", "no_loops")
        refuse(args, of_chain, "must be used with --chain where the scans have poses")
    return chained


def _chain_log(args: argparse.Namespace, steps: list[Step]) -> ChainedScans:
    """Chain the scans of lasers; after Ctrl-C, the scans so far."""
    readings = [step.scan.ranges for step in steps]
    odometry = None if args.no_odometry else _odometry(steps)
    times = np.array([step.scan.time for step in steps])
    known = bool((np.diff(times) >= 0).all())
    spans, lasers = np.array([(step.scan.duration, step.sensor) for step in steps]).T
    durations = [float(np.median(spans[lasers == one])) if known else 0.0 for one in np.unique(lasers)]
    chainer = chaining.Chainer(
        readings, odometry=odometry, times=times if known else None, close_loops=not args.no_loops,
        duration=durations if len(durations) > 1 else durations[0], backend=args.backend, **scanners_of(steps),
    )  # fmt: skip
    begun, done = time.perf_counter(), 0
    with working((chainer,), len(steps) + _ROUNDS) as step:
        for word in chainer.steps():
            for _ in range(max(chainer.scans - done, 1)):
                step(word)
            done = chainer.scans
    chain = chainer.chain()
    placed = [
        replace(step, scan=replace(step.scan, pose=tuple(pose)))
        for step, pose in zip(steps, chain.poses.tolist(), strict=False)
    ]
    return ChainedScans(placed, chain, time.perf_counter() - begun)


def _odometry(steps: list[Step]) -> np.ndarray | None:
    """Return the odometry of scans; None, with a message, if it is absent or constant."""
    poses = np.array([step.scan.odometry for step in steps])
    if len(poses) > 1 and (poses == poses[0]).all():
        sys.stderr.write("gpusense: the odometry of the log never changes: the scans are chained without it\n")
        return None
    return poses


def _write_chain(args: argparse.Namespace, chained: ChainedScans, grid: gs.OccupancyGrid) -> None:
    """Write the requested files: trajectory, poses with covariances, picture."""
    from gpusense.plots.runs import chain_figure

    chain = chained.chain
    # If beams are in reverse order, poses belong to the end of scans.
    at = np.array([step.scan.time for step in chained.steps]) + chain.later
    # Write one pose per time of several lasers.
    rows = np.unique(at, return_index=True)[1] if len(np.unique(chain.sensor)) > 1 else np.arange(len(at))
    write_trajectory(args.tum, at[rows].tolist(), chain.poses[rows])
    x, y, theta = chain.poses.T
    upper = zip(_COVARIANCES, chain.covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T, strict=True)
    write_table(
        args.poses, scan=[step.index for step in chained.steps], time=[f"{time:.6f}" for time in at], x=x, y=y,
        theta=theta, **dict(upper), doubtful=chain.doubtful.astype(int), laser=chain.sensor,
    )  # fmt: skip
    draw(args.plot, lambda: chain_figure(grid, chain))


def _chain_document(args: argparse.Namespace, chained: ChainedScans) -> dict[str, Any]:
    """Return the facts of a chain for ``--json``."""
    chain = chained.chain
    corrections = chain.corrections
    return {
        "seconds": chained.seconds, "matched": chain.matched, "key_scans": len(chain.keys), "links": len(chain.links),
        "closures": len(corrections), "largest_correction": float(corrections.max()) if len(corrections) else None,
        "scan_duration": chain.duration, "odometry": chain.motion is not None,
        "doubtful_scans": int(chain.doubtful.sum()),
        "doubts": [doubt._asdict() for doubt in chain.doubts],
        "files": {name: str(getattr(args, name)) for name in ("tum", "poses", "plot") if getattr(args, name)},
    }  # fmt: skip


def _print_chain(chained: ChainedScans) -> None:
    """Print the verdict on a chain, its closures and its doubtful stretches."""
    chain = chained.chain
    way = float(np.hypot(*np.diff(chain.poses[:, :2], axis=0).T).sum())
    share = chain.doubtful.mean() if len(chain.poses) else 0.0
    verdict = "CONSISTENT" if not chain.doubts else f"DOUBTFUL in {counted(len(chain.doubts), 'stretch', 'stretches')}"
    doubt = f", {100 * share:.2g} % of them in doubt" if chain.doubts else ""
    output.result(f"{verdict}: chained {counted(len(chain.poses), 'scan')} over {way:.0f} m{doubt}")
    if len(chain.corrections):
        output.fact("loops", f"{len(chain.corrections)} closed, moving scans by {np.median(chain.corrections):.2f} m "
                    f"in the median, {chain.corrections.max():.2f} m at most")  # fmt: skip
    else:
        output.fact("loops", "none closed, since no place was seen again with certainty: the map bends by the drift of "
                    "the whole way")  # fmt: skip
    for reason, meaning in chain_result.REASONS.items():
        some = [doubt for doubt in chain.doubts if doubt.reason == reason]
        if some:
            spans = ", ".join(f"{doubt.first} to {doubt.last}" for doubt in some[:5])
            more = f" and {len(some) - 5} more" if len(some) > 5 else ""
            output.fact("doubt", f"scans {spans}{more}: {meaning}")
