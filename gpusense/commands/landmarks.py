"""Run ``gpusense landmarks``: noise, suspicious landmarks, association and localisation of a recorded run."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util.progress import progress
from gpusense.commands.arguments import (
    add_backend,
    add_json,
    add_seed,
    not_negative_number,
    positive_number,
    range_number,
    whole_number,
)
from gpusense.commands.output import counted, degrees, length, print_fact, print_parameters, print_report, print_result
from gpusense.evaluation.machine import machine_line
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.evaluation.landmark_runs import DriftingOdometry, Track
    from gpusense.learning.fitted import LandmarkFit
    from gpusense.learning.landmark.suspicious import Suspicions
    from gpusense.logs.records import LandmarkRun

NAME = "landmarks"
HELP = "Fit the noise of landmark readings in a recorded run, check the map, and localise the robot."
FIRST = ("folder", "robot", "known", "particles", "drift")

LOST = 1
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

Exit codes: 0 success, 1 lost at the end, 2 bad input.

examples:
  gpusense landmarks --folder MRCLAM_Dataset1 --robot 1
  gpusense landmarks --folder MRCLAM_Dataset1 --robot 2 --unknown \\
      --particles 5000"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("--folder", required=True, type=Path, metavar="DIR", help="the recorded run, in the format below")
    add("--robot", required=True, type=whole_number(low=1), metavar="N", help="number in its files' names")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--known", dest="known", action="store_true", default=True,
        help="the landmark of each reading is known by its barcode (default)")  # fmt: skip
    kind.add_argument("--unknown", dest="known", action="store_false", help="the landmark of each reading is unknown")
    add("--particles", type=whole_number(low=2), default=DEFAULTS.particles, metavar="N",
        help="number of the filter's particles (default: %(default)s)")  # fmt: skip
    add("--drift", type=not_negative_number, nargs=2, metavar=("M", "RAD"),
        help="random walks of the translation [m/sqrt(s)] and of the heading [rad/sqrt(s)] "
        "(default: 0.01 and the measured error of the odometer's heading)")  # fmt: skip
    add("--fit-motion", action="store_true", help="learn the motion noise from the logged poses of this run first")
    add("--scans", type=whole_number(low=1), metavar="S", help="largest number of scans (default: all)")
    add("--range-max", type=range_number, metavar="M",
        help="the sensor's largest range [m] (default: the next metre above the largest reading)")  # fmt: skip
    add("--field-of-view", type=positive_number, metavar="RAD",
        help="the sensor's field of view [rad] (default: 5 %% more than the readings' span)")  # fmt: skip
    add_backend(parser)
    add_seed(parser)
    add_json(parser, verbose=True)


def run(args: argparse.Namespace) -> int:
    """Fit the noise, check the map, associate, localise, and print the results."""
    from gpusense.evaluation import landmark_runs
    from gpusense.evaluation.landmark_runs import run_motion
    from gpusense.learning.landmark.suspicious import suspicious_landmarks
    from gpusense.logs.mrclam import read_mrclam
    from gpusense.models.landmark.model import LandmarkModel

    if args.field_of_view is not None and args.field_of_view > 2 * math.pi:
        raise ValueError(f"--field-of-view: must be in (0, 2 pi], got {args.field_of_view:g}")
    recorded = read_mrclam(args.folder, args.robot, range_max=args.range_max, field_of_view=args.field_of_view)
    recorded_run = landmark_runs.first_scans(recorded, args.scans)
    # Suspicions need the recorded landmarks even with --unknown.
    known_fit = landmark_runs.fit_run(recorded_run)
    suspicions = suspicious_landmarks(
        recorded_run.poses, recorded_run.features, recorded_run.landmarks, recorded_run.ids, known_fit.parameters
    )
    fit = known_fit if args.known else landmark_runs.fit_run(recorded_run, known=False)
    model = LandmarkModel(recorded_run.landmarks, landmark_runs.usable(fit.parameters), backend=args.backend)
    agreement = landmark_runs.association(recorded_run, model)
    drift = None if args.drift is None else tuple(args.drift)
    motion = run_motion(recorded_run, drift=drift, fit=args.fit_motion)
    try:
        with progress((len(recorded_run.time) + 99) // 100) as step:
            track = landmark_runs.localise(
                recorded_run, model, known=args.known, particles=args.particles, seed=args.seed, motion=motion,
                step=step,
            )  # fmt: skip
    except KeyboardInterrupt:
        _print_fit(args, fit)
        raise
    if args.json:
        print_report(_document(recorded_run, fit, suspicions, agreement, track, motion, model.device.selection), args)
    else:
        _print(args, recorded_run, fit, suspicions, agreement, track, motion)
    return LOST if track.lost else 0


def _print_fit(args: argparse.Namespace, fit: LandmarkFit) -> None:
    """Print the fit of a run with an interrupted localisation."""
    if args.json:
        print_report({"interrupted": True, "fit": fit.to_dict()})
    else:
        print(f"interrupted while localising; the noise of the sensor:\n\n{fit}")


def _document(
    recorded_run: LandmarkRun, fit: LandmarkFit, suspicions: Suspicions, agreement: dict[str, float], track: Track,
    motion: DriftingOdometry, device: str,
) -> dict[str, Any]:  # fmt: skip
    label = recorded_run.labels.tolist()
    return {
        "scans": len(recorded_run.time),
        "features": len(recorded_run.ids),
        "left_out": recorded_run.left_out,
        "fit": fit.to_dict(),
        "exchanged": [
            asdict(pair) | {"first": label[pair.first], "second": label[pair.second]} for pair in suspicions.exchanged
        ],
        "misplaced": [asdict(each) | {"landmark": label[each.landmark]} for each in suspicions.misplaced],
        "association": agreement,
        "motion": asdict(motion),
        "filter": track.summary(),
        "device": device,
    }


def _print(
    args: argparse.Namespace, recorded_run: LandmarkRun, fit: LandmarkFit, suspicions: Suspicions,
    agreement: dict[str, float], track: Track, motion: DriftingOdometry,
) -> None:  # fmt: skip
    s: dict[str, Any] = track.summary()
    kind = "known" if args.known else "unknown"
    doubts = len(suspicions.exchanged) + len(suspicions.misplaced)
    print_result(f"{_verdict(track)}; {counted(doubts, 'suspicion')} about landmarks")
    print_fact("error", f"median {length(s['error_median'])}, 90 % below {length(s['error_90'])}, at most "
               f"{length(s['error_max'])}; heading {degrees(s['heading_median'])}, "
               f"{degrees(s['heading_90'])} and {degrees(float(track.error_heading.max()))} degrees")  # fmt: skip
    _print_suspicions(recorded_run, suspicions)
    right, wrong, none = (f"{100 * agreement[name]:.1f} %" for name in ("right", "wrong", "none"))
    print_fact("likeliest", f"landmark at the logged pose: right {right}, wrong {wrong}, taken for false "
               f"positives {none}")  # fmt: skip
    print_fact("readings", f"{len(recorded_run.ids)} of {len(recorded_run.landmarks)} landmarks in "
               f"{len(recorded_run.time)} scans, {args.particles} particles, {kind} landmarks")  # fmt: skip
    print_parameters(fit.parameters, fit.standard_errors, _UNITS)
    if args.verbose:
        print(f"\n{fit}")
        left_out = ", ".join(f"{count} {reason}" for reason, count in recorded_run.left_out.items())
        alpha = " ".join(f"{value:.3g}" for value in motion.alpha)
        print(
            f"\nleft out of the recording: {left_out}\nmotion noise {alpha}, reverse {motion.reverse:.2g}, random walk "
            f"{motion.drift:.2g} m and {motion.drift_heading:.2g} rad per sqrt(s)\n{machine_line()}"
        )


def _verdict(track: Track) -> str:
    s = track.summary()
    if s["gain_last"] is None:
        return "NO VERDICT: too few scans with readings"
    share = f"the particles predict a reading {s['gain_last']:.1f} nats better than chance; p_lost {s['p_lost']:.2g}"
    if track.lost:
        return f"LOST since {s['lost_since']:.0f} s: {share}; is this the map of the run, and --drift large enough?"
    before = f"; lost in {s['scans_lost']} scans before" if s["scans_lost"] else ""
    return f"TRACKING: {share}{before}"


def _print_suspicions(recorded_run: LandmarkRun, suspicions: Suspicions) -> None:
    labels = recorded_run.labels
    for pair in suspicions.exchanged:
        a, b = labels[pair.first], labels[pair.second]
        before, after = (" and ".join(f"{100 * each:.0f} %" for each in both) for both in (pair.before, pair.after))
        print_fact("SUSPICIOUS", f"landmarks {a} and {b} fit better exchanged: {before} of their readings agree with "
                   f"the map, {after} with both exchanged")  # fmt: skip
    for each in suspicions.misplaced:
        print_fact("SUSPICIOUS", f"landmark {labels[each.landmark]}: {100 * each.agree:.0f} % of its readings agree "
                   "with its place")  # fmt: skip
    if not (suspicions.exchanged or suspicions.misplaced):
        print_fact("map", "no landmark is suspicious")
