"""Record a filter's run for the viewer Rerun: map, particles, scan, estimated and reference poses, errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.extras import library
from gpusense._util.files import write_whole
from gpusense.plots.drawing import (
    BEAM,
    CLOUD,
    ESTIMATE,
    FRAME,
    FREE,
    OCCUPIED,
    REFERENCE,
    UNKNOWN,
    VERDICTS,
    draw_map,
    end_points,
    new_figure,
)
from gpusense.world.grid import OccupancyGrid

if TYPE_CHECKING:
    from gpusense.evaluation.judging import Judgement
    from gpusense.evaluation.log_steps import Step
    from gpusense.evaluation.tracking import Track
    from gpusense.localization.filter import ParticleFilter
    from gpusense.logs import Scan

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
        pose, error, cloud = track.poses[-1], math.nan, pf.host_particles()
        if step.reference is not None:
            error = float(np.hypot(*(pose[:2] - step.reference[:2])))
        self._scan(step.index, step.scan, pose, "estimate", error=error, effective_sample_size=track.sizes[-1],
                   p_lost=track.p_lost[-1])  # fmt: skip
        self._points("particles", cloud[:: max(len(cloud) // _PARTICLES, 1), :2], _CLOUD, 0.02)
        if step.reference is not None:
            self._arrow("reference", np.array(step.reference), _REFERENCE)

    def write(self, track: Track, path: Path) -> None:
        """Write the recording atomically as a file .rrd."""
        paths = [("path/estimate", np.array(track.poses).reshape(-1, 3), _ESTIMATE)]
        if track.references is not None:
            known = np.isfinite(track.references[:, 0])
            paths.append(("path/reference", track.references[known], _REFERENCE))
        self._write(paths, path)

    def write_judgement(self, found: Judgement, scans: Sequence[Scan], path: Path) -> None:
        """Write a judgement of N poses by N scans atomically as a file .rrd."""
        columns = (found.index.tolist(), scans, found.poses, found.p_lost, found.explained, found.radii)
        for index, scan, pose, p_lost, explained, radius in zip(*columns, strict=True):
            self._scan(index, scan, pose, "pose", p_lost=p_lost, explained=explained, radius=radius)
        for one in found.stretches:
            if one.place is not None and math.isfinite(one.off):
                self._stream.set_time("scan", sequence=int(found.index[one.first]))
                self._arrow("likeliest_place", one.place.pose, _REFERENCE)
        self._write([("path/poses", found.poses, _ESTIMATE)], path)

    def _scan(self, index: int, scan: Scan, pose: NDArray[np.float64], name: str, **numbers: float) -> None:
        """Record a scan at a pose, with the finite ones of some numbers."""
        self._stream.set_time("scan", sequence=index)
        self._points("scan", end_points(scan.ranges, scan.scanner, pose), _SCAN, 0.03)
        self._arrow(name, pose, _ESTIMATE)
        for key, number in numbers.items():
            if math.isfinite(number):
                self._stream.log(key, self._rr.Scalars(float(number)))

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


def _flat(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Embed points of the plane in space."""
    return np.column_stack([xy, np.zeros(len(xy))])


# Most frames, and particles per frame; time of a frame [ms]; longer side [inches], dots per inch.
FRAMES, PARTICLES, DURATION, SIDE, DPI = 100, 2000, 100, 7.0, 80
# Colours of all frames.
_COLOURS = (
    FREE, UNKNOWN, OCCUPIED, FRAME, BEAM, CLOUD, ESTIMATE, REFERENCE, "#000000", *VERDICTS.values(),
)  # fmt: skip


class Animation:
    """Frames of a run, in memory until written.

    Args:
        grid: The map.
        scans: Number of scans of the run; at most ``FRAMES`` become frames.
    """

    def __init__(self, grid: OccupancyGrid, scans: int) -> None:
        x_min, y_min, x_max, y_max = grid.bounds()
        scale = SIDE / max(x_max - x_min, y_max - y_min)
        self._figure = new_figure(max((x_max - x_min) * scale, 3.0), max((y_max - y_min) * scale, 2.0) + 0.4)
        self._figure.set_dpi(DPI)
        self._ax = self._figure.subplots()
        draw_map(self._ax, grid)
        self._ax.set(xlabel="", ylabel="")
        plot: Any = self._ax.plot
        self._cloud = plot([], [], ".", color=CLOUD, ms=2, zorder=3)[0]
        self._scan = plot([], [], ".", color=BEAM, ms=3, zorder=4)[0]
        self._truth = plot([], [], "-", color=REFERENCE, lw=1.6, zorder=3)[0]
        self._robot = plot([], [], "o", color=ESTIMATE, ms=8, zorder=5)[0]
        self._each, self._scans, self._frames = -(-scans // FRAMES), 0, list[Any]()

    def add(self, pf: ParticleFilter, track: Track, step: Step) -> None:
        """Draw the last scan of a track, if it is due for a frame."""
        self._scans += 1
        if (self._scans - 1) % self._each:
            return
        from PIL import Image

        pose, verdict = track.poses[-1], track.verdicts[-1]
        cloud = pf.host_particles()
        self._cloud.set_data(*cloud[:: max(len(cloud) // PARTICLES, 1), :2].T)
        self._scan.set_data(*end_points(step.scan.ranges, step.scan.scanner, pose).T)
        self._robot.set_data(*pose[:2, None])
        # Before convergence the mean of particles that lie apart is no pose of the robot.
        self._robot.set_fillstyle("none" if track.converged is None else "full")
        self._robot.set_alpha(0.5 if track.converged is None else 1.0)
        if track.references is not None:
            self._truth.set_data(*track.references[:, :2].T)
        title = f"scan {step.index}: {verdict.upper()} (p_lost {track.p_lost[-1]:.2g})"
        self._ax.set_title(title, color=VERDICTS[verdict], loc="left")
        canvas: Any = self._figure.canvas
        canvas.draw()
        self._frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))

    def write(self, track: Track, path: Path) -> None:
        """Write the frames atomically as a repeating GIF."""
        from PIL import Image, ImageColor

        # All colours, and their mixtures with white along the edges of shapes.
        colours = [ImageColor.getrgb(name) for name in _COLOURS]
        mixed = [255 + (np.array(colours) - 255) * share for share in (1, 0.75, 0.5, 0.25)]
        palette = Image.new("P", (1, 1))
        palette.putpalette(np.concatenate(mixed).astype(np.uint8).tobytes())
        first, *rest = (frame.quantize(palette=palette, dither=0) for frame in self._frames)
        options: dict[str, Any] = dict(format="GIF", save_all=True, append_images=rest, duration=DURATION, loop=0)
        write_whole(path, lambda stream: first.save(stream, **options))
