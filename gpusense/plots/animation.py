"""Animate a run of a particle filter as a GIF: particles, scan, estimate and verdict on the map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
    new_figure,
)
from gpusense.plots.viewer import end_points
from gpusense.world.grid import OccupancyGrid

if TYPE_CHECKING:
    from gpusense.evaluation.steps import Step
    from gpusense.evaluation.tracking import Track
    from gpusense.localization.filter import ParticleFilter

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
        self._scan.set_data(*end_points(step.scan.scanner, step.scan.ranges, pose).T)
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
