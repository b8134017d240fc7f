"""Draw maps, scans, particles, fits and positions onto a Matplotlib ``Axes``."""

from gpusense.plots.drawing import (
    add_colour_bar,
    add_legend,
    colours,
    draw_map,
    draw_pose,
    draw_scan,
    new_figure,
    save,
)
from gpusense.plots.features import draw_features, draw_landmarks
from gpusense.plots.pose_densities import draw_likelihood_field, draw_particles, draw_pose_likelihood
from gpusense.plots.positions import (
    draw_beacons,
    draw_fix,
    draw_position_density,
    draw_solution_set,
    position_log_density,
    set_view,
    tile_centers,
)

__all__ = [
    "add_colour_bar",
    "add_legend",
    "colours",
    "draw_beacons",
    "draw_features",
    "draw_fix",
    "draw_landmarks",
    "draw_likelihood_field",
    "draw_map",
    "draw_particles",
    "draw_pose",
    "draw_pose_likelihood",
    "draw_position_density",
    "draw_scan",
    "draw_solution_set",
    "new_figure",
    "position_log_density",
    "save",
    "set_view",
    "tile_centers",
]
