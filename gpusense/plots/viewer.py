"""Record a filter's run for the viewer Rerun: map, particles, scan, estimated and reference poses, errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.extras import library
from gpusense._util.files import write_whole
from gpusense.evaluation.judging import Judgement
from gpusense.evaluation.steps import Step
from gpusense.evaluation.tracking import Track
from gpusense.localization.filter import ParticleFilter
from gpusense.localization.pose_algebra import compose_poses
from gpusense.logs import Scan
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, Scanner, classify

# Most particles per scan; length of the robot's arrow [m].
_PARTICLES, _ARROW = 2000, 0.7
# Red, green, blue.
_WALL, _CLOUD, _SCAN = (90, 90, 90), (76, 120, 168), (242, 184, 72)
_ESTIMATE, _REFERENCE = (228, 87, 46), (143, 163, 184)


class Recording:
    """Recording of a run, in memory until written.

    Raises:
        ImportError: rerun-sdk is not installed.
    """

    def __init__(self, grid: OccupancyGrid, name: str = "localize") -> None:
        self._rr: Any = library("rerun", "a recording for Rerun")
        self._stream: Any = self._rr.RecordingStream(f"gpusense {name}")
        self._content = self._stream.binary_stream()
        walls = grid.cell_centers(*np.nonzero(grid.occupied))
        self._points("map", walls, _WALL, grid.resolution / 2, static=True)

    def add(self, pf: ParticleFilter, track: Track, step: Step) -> None:
        """Record the last scan of a track."""
        rr, pose = self._rr, track.poses[-1]
        self._stream.set_time("scan", sequence=step.index)
        cloud = pf.host_particles()
        self._points("particles", cloud[:: max(len(cloud) // _PARTICLES, 1), :2], _CLOUD, 0.02)
        self._points("scan", end_points(step.scan.scanner, step.scan.ranges, pose), _SCAN, 0.03)
        self._arrow("estimate", pose, _ESTIMATE)
        if step.reference is not None:
            self._arrow("reference", np.array(step.reference), _REFERENCE)
            error = float(np.hypot(*(pose[:2] - step.reference[:2])))
            self._stream.log("error", rr.Scalars(error))
        self._stream.log("effective_sample_size", rr.Scalars(track.sizes[-1]))
        self._stream.log("p_lost", rr.Scalars(float(track.p_lost[-1])))

    def write(self, track: Track, path: Path) -> None:
        """Write the recording atomically as a file .rrd."""
        paths = [("path/estimate", np.array(track.poses).reshape(-1, 3), _ESTIMATE)]
        if track.references is not None:
            known = np.isfinite(track.references[:, 0])
            paths.append(("path/reference", track.references[known], _REFERENCE))
        self._write(paths, path)

    def write_judgement(self, found: Judgement, scans: Sequence[Scan], path: Path) -> None:
        """Write a judgement of N poses by N scans atomically as a file .rrd."""
        rr = self._rr
        for k, scan in enumerate(scans):
            self._stream.set_time("scan", sequence=int(found.index[k]))
            self._points("scan", end_points(scan.scanner, scan.ranges, found.poses[k]), _SCAN, 0.03)
            self._arrow("pose", found.poses[k], _ESTIMATE)
            for name, values in (("p_lost", found.p_lost), ("explained", found.explained), ("radius", found.radii)):
                if math.isfinite(values[k]):
                    self._stream.log(name, rr.Scalars(float(values[k])))
        for one in found.stretches:
            if one.place is not None and math.isfinite(one.off):
                self._stream.set_time("scan", sequence=int(found.index[one.first]))
                self._arrow("likeliest_place", one.place.pose, _REFERENCE)
        self._write([("path/poses", found.poses, _ESTIMATE)], path)

    def _write(self, paths: Sequence[tuple[str, NDArray[np.float64], tuple[int, ...]]], path: Path) -> None:
        for name, poses, colour in paths:
            line = self._rr.LineStrips3D([_flat(poses[:, :2])], colors=[colour])
            self._stream.log(name, line, static=True)
        content = self._content.read(flush=True)
        write_whole(path, lambda stream: stream.write(content))

    def _points(self, name: str, xy: NDArray[np.float64], colour: tuple[int, ...], radius: float, **more: bool) -> None:
        points = self._rr.Points3D(_flat(xy), colors=[colour], radii=[radius])
        self._stream.log(name, points, **more)

    def _arrow(self, name: str, pose: NDArray[np.float64], colour: tuple[int, ...]) -> None:
        x, y, theta = (float(value) for value in pose)
        vector = (_ARROW * math.cos(theta), _ARROW * math.sin(theta), 0.0)
        self._stream.log(name, self._rr.Arrows3D(origins=[(x, y, 0.0)], vectors=[vector], colors=[colour]))


def end_points(scanner: Scanner, ranges: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (M, 2) end points in the world of the hits of (K,) readings [m] at a (3,) pose."""
    hit = classify(ranges, scanner) == Reading.HIT
    x, y, theta = compose_poses(pose, np.array(scanner.mount))
    angle, z = theta + scanner.bearings[hit], np.asarray(ranges)[hit]
    return np.column_stack([x + z * np.cos(angle), y + z * np.sin(angle)])


def _flat(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Embed points of the plane in space."""
    return np.column_stack([xy, np.zeros(len(xy))])
