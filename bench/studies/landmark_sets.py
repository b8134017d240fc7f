"""Read recorded runs among landmarks, each in its own text format, as gpusense.logs.records.LandmarkRun."""

from __future__ import annotations

import csv
import gzip
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.evaluation.landmark_runs import first_scans
from gpusense.learning.landmark.suspicious import Suspicions
from gpusense.logs.mrclam import read_mrclam
from gpusense.logs.records import LandmarkRun

# The LEGO robot: metres per tick, distance of its wheels, and radius of a cylinder [m].
_TICK, _TRACK, _AXIS = 0.000349, 0.150, 0.09
# Noise that is added to the simulated robot's odometry: of each turn [rad], and of each distance, as a share of it.
_TURN, _WAY = 0.05, 0.1


def run_of(data: Path, name: str) -> LandmarkRun:
    """Read the run of a name: mrclam_1, mrclam_2, mrclam_3, beacons, lego or freiburg."""
    if name.startswith("mrclam_"):
        return read_mrclam(data / "mrclam_ds1", int(name[-1]))
    return {"beacons": _beacons, "lego": _lego, "freiburg": _freiburg}[name](data)


def _beacons(data: Path) -> LandmarkRun:
    """Read a camera's fiducials; rows are moments, some without a beacon, and poses come from SLAM.

    SLAM is lost from 275 s on and jumps by metres: the run ends where it first moves half a metre more than odometry.
    """
    folder = data / "beacons_enmt482"
    with (folder / "beacon_map.csv").open() as stream:
        places = [(int(row["id"]), float(row["x"]), float(row["y"])) for row in csv.DictReader(stream)]
    index = {row[0]: i for i, row in enumerate(places)}
    with gzip.open(folder / "data.csv.gz", "rt") as stream:
        rows = sorted(csv.DictReader(stream), key=lambda row: int(row["time_ns"]))
    clock = np.array([int(row["time_ns"]) for row in rows])
    _, first, scan = np.unique(clock, return_index=True, return_inverse=True)
    tracks = [np.array([[float(row[f"{frame}_{name}"]) for name in ("x", "y", "theta")] for row in rows])[first]
              for frame in ("odom", "map")]  # fmt: skip
    seen = [(i, row) for i, row in enumerate(rows) if row["beacon_id"]]
    kept = [(i, row) for i, row in seen if int(float(row["beacon_id"])) in index]
    local = np.array([[float(row["beacon_x"]), float(row["beacon_y"])] for _, row in kept])
    features = np.column_stack([np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])])
    way = [np.hypot(*np.diff(track[:, :2], axis=0).T) for track in tracks]
    sound = int(np.argmax(np.append(way[1] - way[0] > 0.5, True))) + 1
    run = LandmarkRun(
        gs.LandmarkMap([row[1:] for row in places]), np.array([row[0] for row in places]),
        (clock[first] - clock[0]) / 1e9, tracks[0], tracks[1], features, scan[[i for i, _ in kept]],
        np.array([index[int(float(row["beacon_id"]))] for _, row in kept]), 6.0,
        2.1 * float(np.abs(features[:, 1]).max()), {"beacons without a place": len(seen) - len(kept),
        "moments after SLAM is lost": len(first) - sound},
    )  # fmt: skip
    return first_scans(run, sound)


def cylinders(ranges: np.ndarray) -> np.ndarray:
    """Find (F, 2) ranges and bearings of cylinders in a scan: readings between a jump inwards and one outwards."""
    bearings = (np.arange(ranges.size) - 330) * 0.006135923 - 0.0698
    found, inside, active = [], [], False
    for k in range(1, ranges.size - 1):
        sound = ranges[k - 1] > 0.02 and ranges[k + 1] > 0.02
        jump = (ranges[k + 1] - ranges[k - 1]) / 2 if sound else 0.0
        if jump < -0.1:
            active, inside = True, []
        elif jump > 0.1 and active:
            if inside:
                found.append((ranges[inside].mean() + _AXIS, bearings[inside].mean()))
            active = False
        elif active and ranges[k] > 0.02:
            inside.append(k)
    return np.array(found).reshape(-1, 2)


def _lego(data: Path) -> LandmarkRun:
    """Read a lidar's cylinders. Positions come from an overhead camera; headings explain the most cylinders."""
    folder = data / "brenner_lego"
    xy = np.loadtxt(folder / "robot_arena_landmarks.txt", usecols=(2, 3)) / 1000
    position = np.loadtxt(folder / "robot4_reference.txt", usecols=(2, 3)) / 1000
    ticks = np.loadtxt(folder / "robot4_motors.txt", usecols=(2, 6))
    with gzip.open(folder / "robot4_scan.txt.gz", "rt") as stream:
        scans = np.array([line.split()[1:2] + line.split()[3:] for line in stream], float)
    found = [cylinders(row / 1000) for row in scans[:, 1:]]
    headings, sure, ids = np.full(len(found), np.nan), [], []
    grid = np.linspace(-np.pi, np.pi, 721)
    for s, (f, here) in enumerate(zip(found, position, strict=True)):
        away = xy - here
        turn = f[:, 1, None] - np.arctan2(away[:, 1], away[:, 0])
        match = np.abs(f[:, 0, None] - np.hypot(*away.T)) < 0.12
        wrapped = np.angle(np.exp(1j * (turn + grid[:, None, None])))
        match = match & (np.abs(wrapped) < 0.06)
        best = int(np.argmax(match.any(axis=2).sum(axis=1)))
        own = match[best]
        ids.append(np.where(own.any(axis=1), own.argmax(axis=1), -1) if len(f) else np.zeros(0, int))
        if own.any(axis=1).sum() >= 2:
            headings[s] = grid[best] - float(wrapped[best][own].mean())
            sure.append(s)
    headings = np.interp(np.arange(len(found)), sure, np.unwrap(headings[sure]))
    left, right = np.diff(ticks, axis=0, prepend=ticks[:1]).T * _TICK
    turned = (right - left) / _TRACK
    angle = np.cumsum(turned)
    way = (left + right) / 2
    odometry = np.column_stack([
        np.cumsum(way * np.cos(angle - turned / 2)), np.cumsum(way * np.sin(angle - turned / 2)), angle
    ])  # fmt: skip
    features, ids = np.concatenate(found), np.concatenate(ids)
    scan = np.repeat(np.arange(len(found)), [len(f) for f in found])
    return LandmarkRun(
        gs.LandmarkMap(xy), np.arange(len(xy)), scans[:, 0] / 1000, odometry, np.column_stack([position, headings]),
        features, scan, ids, 3.0, 2.1 * float(np.abs(features[:, 1]).max()), {},
    )  # fmt: skip


def _freiburg(data: Path) -> LandmarkRun:
    """Read a simulated run without a true path; its nearly exact odometry gives the logged poses.

    Filters get this odometry with the noise of a poor robot added.
    """
    folder = data / "freiburg_course"
    world = np.loadtxt(folder / "world.dat")
    index = {int(row[0]): i for i, row in enumerate(world)}
    steps, rows, below = [], [], 0
    for line in (folder / "sensor_data.dat").read_text().splitlines():
        word, *numbers = line.split()
        if word == "ODOMETRY":
            steps.append([float(number) for number in numbers])
        elif float(numbers[1]) < 0:
            below += 1
        else:
            rows.append((float(numbers[1]), float(numbers[2]), index[int(numbers[0])], len(steps) - 1))
    table, moves = np.array(rows), np.array(steps)
    track = _path(moves)
    noise = np.random.default_rng(0).normal(size=moves.shape)
    poor = _path(
        moves + noise * np.stack([np.full(len(moves), _TURN), _WAY * moves[:, 1], np.full(len(moves), _TURN)], axis=1)
    )
    return LandmarkRun(
        gs.LandmarkMap(world[:, 1:]), world[:, 0].astype(int), np.arange(len(track), dtype=float), poor, track,
        table[:, :2], table[:, 3].astype(int), table[:, 2].astype(int), float(math.ceil(table[:, 0].max())),
        2 * math.pi, {"ranges below 0": below},
    )  # fmt: skip


def _path(moves: np.ndarray) -> np.ndarray:
    """Return (S, 3) poses after (S, 3) first turns, distances and second turns, from the origin."""
    heading = np.cumsum(moves[:, 0] + moves[:, 2])
    along = heading - moves[:, 2]
    return np.column_stack([
        np.cumsum(moves[:, 1] * np.cos(along)), np.cumsum(moves[:, 1] * np.sin(along)), heading
    ])  # fmt: skip


def repaired(run: LandmarkRun, suspected: Suspicions) -> LandmarkRun:
    """Return the run with the positions of exchanged landmarks swapped back."""
    xy = run.landmarks.xy.copy()
    for pair in suspected.exchanged:
        xy[[pair.first, pair.second]] = xy[[pair.second, pair.first]]
    return replace(run, landmarks=gs.LandmarkMap(xy, run.landmarks.signatures))
