"""Find the poses of a log's scans by a chain of matches, for ``gpusense map``."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpusense._util.progress import progress
from gpusense.commands.arguments import output_path
from gpusense.commands.output import counted, print_fact, print_result
from gpusense.commands.scans import scan_times, scanners_of
from gpusense.commands.signals import word_of

if TYPE_CHECKING:
    from gpusense.chaining.result import ScanChain
    from gpusense.logs import Scan
    from gpusense.world.grid import OccupancyGrid

    Scans = list[tuple[int, Scan]]

# Steps of the progress bar during the search for loops.
_ROUNDS = 20
# Columns of a file of poses.
_COLUMNS = "scan,time,x,y,theta,var_x,cov_xy,cov_xtheta,var_y,cov_ytheta,var_theta,doubtful,laser"


@dataclass
class ChainedScans:
    """Scans with poses from a chain.

    Attributes:
        stop: Signal that interrupted the chain; None for a complete chain.
    """

    scans: Scans
    chain: ScanChain
    seconds: float
    stop: KeyboardInterrupt | None


def add_chain(parser: argparse.ArgumentParser) -> None:
    """Add the options of a chain."""
    add = parser.add_argument
    add("--chain", action="store_true",
        help="find the poses by matching the scans and closing loops, even if the log has "
        "poses (default: if it has none)")  # fmt: skip
    add("--no-odometry", action="store_true", help="chain the scans without the log's odometry")
    add("--no-loops", action="store_true", help="do not search for revisited places")
    add("--tum", type=output_path(".tum", ".txt"), metavar="FILE", help="write the poses of a chain for evo")
    add("--poses", type=output_path(".csv"), metavar="CSV",
        help="write the poses of a chain with covariances and doubts")  # fmt: skip
    add("--plot", type=output_path(".png", ".pdf", ".svg"), metavar="FILE",
        help="draw the map with trajectory, closures and doubtful stretches of a chain")  # fmt: skip


def check_chain(args: argparse.Namespace) -> None:
    """Check that a chain and a trajectory are not both requested."""
    if args.chain and args.reference is not None:
        raise ValueError("--chain: must not be used with --reference, which has the poses, got both")


def is_chained(args: argparse.Namespace, scans: Scans) -> bool:
    """Return whether a chain finds the poses, and check the options that need a chain."""
    chained = args.chain or (args.reference is None and any(scan.pose is None for _, scan in scans))
    for name in ("tum", "poses", "plot", "no_odometry", "no_loops"):
        if not chained and getattr(args, name):
            option = name.replace("_", "-")
            raise ValueError(f"--{option}: must be used with --chain where the scans have poses, got it without")
    return chained


def chain_log(args: argparse.Namespace, scans: Scans, sensor: list[int]) -> ChainedScans:
    """Chain the scans of lasers; after Ctrl-C, the scans so far."""
    from gpusense.chaining.chain import Chainer

    readings = [scan.ranges for _, scan in scans]
    odometry = None if args.no_odometry else _odometry(scans)
    times = np.array([scan.time for _, scan in scans])
    known = bool((np.diff(times) >= 0).all())
    each = [
        [scan.duration for (_, scan), k in zip(scans, sensor, strict=True) if k == one] for one in sorted(set(sensor))
    ]
    durations = [float(np.median(some)) if known else 0.0 for some in each]
    chainer = Chainer(
        readings, odometry=odometry, times=times if known else None, close_loops=not args.no_loops,
        duration=durations if len(durations) > 1 else durations[0], backend=args.backend, **scanners_of(scans, sensor),
    )  # fmt: skip
    begun, stop = time.perf_counter(), None
    with progress(len(scans) + _ROUNDS) as step:
        try:
            done = 0
            for word in chainer.steps():
                for _ in range(max(chainer.scans - done, 1)):
                    step(word)
                done = chainer.scans
        except KeyboardInterrupt as signal:
            stop = signal
            sys.stderr.write(f"gpusense: {word_of(stop)}: the map holds the scans chained so far\n")
    chain = chainer.chain()
    placed = [
        (index, replace(scan, pose=tuple(pose)))
        for (index, scan), pose in zip(scans, chain.poses.tolist(), strict=False)
    ]
    return ChainedScans(placed, chain, time.perf_counter() - begun, stop)


def _odometry(scans: Scans) -> np.ndarray | None:
    """Return the odometry of scans; None, with a message, if it is absent or constant."""
    poses = np.array([scan.odometry for _, scan in scans])
    if len(poses) > 1 and (poses == poses[0]).all():
        sys.stderr.write("gpusense: the odometry of the log never changes: the scans are chained without it\n")
        return None
    return poses


def write_chain(args: argparse.Namespace, chained: ChainedScans, grid: OccupancyGrid) -> None:
    """Write the requested files: trajectory, poses with covariances, picture."""
    from gpusense.evaluation.trajectory_files import write_tum

    if args.tum is not None:
        # If beams are in reverse order, poses belong to the end of scans.
        at = np.array([scan.time for _, scan in chained.scans]) + chained.chain.later
        rows = np.arange(len(at))
        if len(np.unique(chained.chain.sensor)) > 1:
            # Write one pose per time of several lasers.
            rows = np.unique(at, return_index=True)[1]
        times, indices = scan_times(at[rows].tolist())
        write_tum(args.tum, times, chained.chain.poses[rows], indices=indices)
    if args.poses is not None:
        _write_poses(args.poses, chained)
    if args.plot is not None:
        from gpusense.plots.chains import chain_figure
        from gpusense.plots.drawing import save

        save(chain_figure(grid, chained.chain), args.plot)


def _write_poses(path: Path, chained: ChainedScans) -> None:
    """Write one line per scan: index, time, pose, upper triangle of the covariance, whether doubtful, laser."""
    from gpusense._util.files import write_whole

    lines, chain = [_COLUMNS], chained.chain
    upper = chain.covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    rows = zip(chained.scans, chain.poses, upper, chain.doubtful, chain.later, chain.sensor, strict=True)
    for (index, scan), pose, spread, doubt, later, laser in rows:
        numbers = ",".join(f"{value:.9g}" for value in (*pose, *spread))
        lines.append(f"{index},{scan.time + later:.6f},{numbers},{int(doubt)},{laser}")
    text = "\n".join(lines) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def document(args: argparse.Namespace, chained: ChainedScans) -> dict[str, Any]:
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


def print_chain(chained: ChainedScans) -> None:
    """Print the verdict on a chain, its closures and its doubtful stretches."""
    from gpusense.chaining.result import REASONS

    chain = chained.chain
    way = float(np.hypot(*np.diff(chain.poses[:, :2], axis=0).T).sum())
    share = chain.doubtful.mean() if len(chain.poses) else 0.0
    verdict = "CONSISTENT" if not chain.doubts else f"DOUBTFUL in {counted(len(chain.doubts), 'stretch', 'stretches')}"
    doubt = f", {100 * share:.2g} % of them in doubt" if chain.doubts else ""
    print_result(f"{verdict}: chained {counted(len(chain.poses), 'scan')} over {way:.0f} m{doubt}")
    if len(chain.corrections):
        print_fact("loops", f"{len(chain.corrections)} closed, moving scans by {np.median(chain.corrections):.2f} m in "
                   f"the median, {chain.corrections.max():.2f} m at most")  # fmt: skip
    else:
        print_fact("loops", "none closed, since no place was seen again with certainty: the map bends by the drift of "
                   "the whole way")  # fmt: skip
    for reason, meaning in REASONS.items():
        some = [doubt for doubt in chain.doubts if doubt.reason == reason]
        if some:
            spans = ", ".join(f"{doubt.first} to {doubt.last}" for doubt in some[:5])
            more = f" and {len(some) - 5} more" if len(some) > 5 else ""
            print_fact("doubt", f"scans {spans}{more}: {meaning}")
