"""Run ``gpusense landmarks``: noise, suspicious landmarks, association and localisation of a recorded run."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.arguments import Options, not_negative_number, range_number, whole_number
from gpusense.commands.output import counted, degrees, length
from gpusense.commands.signals import working
from gpusense.evaluation import landmark_runs, tracking
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.learning.landmark.pairs import Suspicions
    from gpusense.logs.records import LandmarkRun

FIRST = ("folder", "robot", "known", "particles", "drift")
SHARED = ("backend", "seed", "verbose")
CODES = {1: "lost at the end"}

_UNITS = {"sigma_range": "m", "sigma_bearing": "rad"}

EPILOG = """\
The folder holds files in the format of the UTIAS MRCLAM data, plain or with .gz after the name:
  Landmark_Groundtruth.dat  subject x y deviation deviation
  Barcodes.dat              subject barcode
  RobotN_Odometry.dat       time v w
  RobotN_Measurement.dat    time barcode range bearing
  RobotN_Groundtruth.dat    time x y heading
Parameters are fitted at the logged poses. A particle filter then starts around the first logged pose (0.5 m, 0.3 rad)
and uses only odometry and readings; with --known also the recorded landmark of each reading. The map is used unchanged:
readings of exchanged landmarks count as false positives.

The filter's motion noise combines the noise of the odometry (0.09 0.01 0.04 0.0004, or --fit-motion) and a random walk.
The walk of the heading is measured at the logged poses unless --drift sets it. Poor odometry needs a large walk; with a
small one the robot gets lost.

The final verdict needs no logged poses: it is 'lost' if the particles predict the last readings hardly better than
poses anywhere among the landmarks, as on a wrong map.

examples:
  gpusense landmarks --folder MRCLAM_Dataset1 --robot 1
  gpusense landmarks --folder MRCLAM_Dataset1 --robot 2 --unknown \\
      --particles 5000"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--folder DIR", "the recorded run, in the format below", Path, required=True)
    add("--robot N", "number in its files' names", whole_number(low=1), required=True)
    with add.exclusive():
        add("--known", "the landmark of each reading is known by its barcode (default)", dest="known",
            action="store_true", default=True)  # fmt: skip
        add("--unknown", "the landmark of each reading is unknown", dest="known", action="store_false")
    add("--particles N", "number of the filter's particles", whole_number(low=2), DEFAULTS.particles)
    add("--drift M RAD", "random walks of the translation [m/sqrt(s)] and of the heading [rad/sqrt(s)] "
        "(default: 0.01 and the measured error of the odometer's heading)", not_negative_number)  # fmt: skip
    add("--fit-motion", "learn the motion noise from the logged poses of this run first")
    add("--scans S", "largest number of scans (default: all)", whole_number(low=1))
    add("--range-max M", "the sensor's largest range [m] (default: the next metre above the largest reading)",
        range_number)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Fit the noise, check the map, associate, localise, and print the results; after Ctrl-C, of the scans so far."""
    from gpusense.logs.mrclam import read_mrclam

    recorded = landmark_runs.first_scans(read_mrclam(args.folder, args.robot, range_max=args.range_max), args.scans)
    # Suspicions need the recorded landmarks even with --unknown.
    fit = landmark_runs.fit_run(recorded)
    doubts = gs.suspicious_landmarks(
        recorded.poses, recorded.features, recorded.landmarks, recorded.ids, fit.parameters
    )
    fit = fit if args.known else landmark_runs.fit_run(recorded, known=False)
    model = gs.LandmarkModel(recorded.landmarks, landmark_runs.usable(fit.parameters), backend=args.backend)
    agreement = landmark_runs.association(recorded, model)
    drift = None if args.drift is None else tuple(args.drift)
    motion = landmark_runs.run_motion(recorded, drift=drift, fit=args.fit_motion)
    pf, track = (
        landmark_runs.make_filter(recorded, model, motion, particles=args.particles, seed=args.seed),
        tracking.Track(),
    )
    with working(track.steps, len(recorded.time)) as step:
        for one in landmark_runs.follow(pf, recorded, track, known=args.known):
            step(f"scan {one.index}" + (", lost" if track.verdicts[-1] == "lost" else ""))
    figures = tracking.summary(track)
    if args.json:
        output.report(_document(recorded, fit, doubts) | {
            "association": agreement, "motion": asdict(motion), "filter": figures, "device": model.device.selection,
        }, args)  # fmt: skip
    else:
        _print(args, recorded, fit, doubts, agreement, figures)
        alpha = " ".join(f"{value:.3g}" for value in motion.alpha)
        output.details(
            args,
            f"{fit}\n\nleft out of the recording: {_left_out(recorded)}\nmotion noise {alpha}, reverse "
            f"{motion.reverse:.2g}, random walk {motion.drift:.2g} m and {motion.drift_heading:.2g} rad per sqrt(s)",
        )
    return int(track.verdict == "lost")


def _left_out(run: LandmarkRun) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in run.left_out.items())


def _document(run: LandmarkRun, fit: gs.LandmarkFit, doubts: Suspicions) -> dict[str, Any]:
    label = run.labels.tolist()
    return {
        "scans": len(run.time), "features": len(run.ids), "left_out": run.left_out, "fit": fit.to_dict(),
        "exchanged": [
            asdict(pair) | {"first": label[pair.first], "second": label[pair.second]} for pair in doubts.exchanged
        ],
        "misplaced": [asdict(each) | {"landmark": label[each.landmark]} for each in doubts.misplaced],
    }  # fmt: skip


def _print(
    args: argparse.Namespace, run: LandmarkRun, fit: gs.LandmarkFit, doubts: Suspicions, agreement: dict[str, float],
    figures: dict[str, Any],
) -> None:  # fmt: skip
    kind = "known" if args.known else "unknown"
    count = len(doubts.exchanged) + len(doubts.misplaced)
    output.result(f"{_verdict(figures)}; {counted(count, 'suspicion')} about landmarks")
    output.interrupted(figures["scans"], len(run.time))
    output.fact("error", f"median {length(figures['error_median'])}, 95 % below {length(figures['error_95'])}; heading "
                f"{degrees(figures['heading_median'])} and {degrees(figures['heading_95'])} degrees")  # fmt: skip
    _print_suspicions(run, doubts)
    right, wrong, none = (f"{100 * agreement[name]:.1f} %" for name in ("right", "wrong", "none"))
    output.fact("likeliest", f"landmark at the logged pose: right {right}, wrong {wrong}, taken for false "
                f"positives {none}")  # fmt: skip
    output.fact("readings", f"{len(run.ids)} of {len(run.landmarks)} landmarks in {len(run.time)} scans, "
                f"{args.particles} particles, {kind} landmarks")  # fmt: skip
    output.parameters(fit.parameters, fit.standard_errors, _UNITS)


def _verdict(figures: dict[str, Any]) -> str:
    verdict = figures["verdict"]
    since = f"; lost in {figures['scans_lost']} scans" if figures["scans_lost"] else ""
    cure = "; is this the map of the run, and --drift large enough?" if verdict == "lost" else ""
    return f"{verdict.upper()}: p_lost {figures['p_lost']:.2g}{since}{cure}"


def _print_suspicions(run: LandmarkRun, suspicions: Suspicions) -> None:
    labels = run.labels
    for pair in suspicions.exchanged:
        a, b = labels[pair.first], labels[pair.second]
        before, after = (" and ".join(f"{100 * each:.0f} %" for each in both) for both in (pair.before, pair.after))
        output.fact("SUSPICIOUS", f"landmarks {a} and {b} fit better exchanged: {before} of their readings agree with "
                    f"the map, {after} with both exchanged")  # fmt: skip
    for each in suspicions.misplaced:
        output.fact("SUSPICIOUS", f"landmark {labels[each.landmark]}: {100 * each.agree:.0f} % of its readings agree "
                    "with its place")  # fmt: skip
    if not (suspicions.exchanged or suspicions.misplaced):
        output.fact("map", "no landmark is suspicious")
