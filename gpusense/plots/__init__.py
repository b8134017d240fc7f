"""Draw maps, scans, particles, fits and positions, each onto a Matplotlib ``Axes``."""

from gpusense.plots.drawing import (
    add_colour_bar,
    draw_map,
    draw_particles,
    draw_pose,
    draw_pose_density,
    draw_scan,
    localization_figure,
    new_figure,
    pose_lattice,
    save,
)

__all__ = [
    "add_colour_bar",
    "draw_map",
    "draw_particles",
    "draw_pose",
    "draw_pose_density",
    "draw_scan",
    "localization_figure",
    "new_figure",
    "pose_lattice",
    "save",
]
