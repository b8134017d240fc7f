"""
Positions from landmarks
========================

Distances to two landmarks leave two positions, and bearings of three leave one, each with an uncertainty whose shape
depends on the geometry (book section 6.6). Left: the sets that each measurement allows. Right: the density, and the
solutions with their 95 % ellipses. **Try:** landmarks on a line.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

landmarks = np.array([(1.0, 1.0), (8.0, 2.0), (4.5, 7.0)])
truth = np.array([4.0, 3.5, 0.6])
away = landmarks - truth[:2]
ranges, bearings = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0]) - truth[2]
extent = (-1.0, 10.0, -3.0, 8.0)
points = gs.plots.tile_centers(extent, 200)

figure, panels = plt.subplots(2, 2, figsize=(10, 9), layout="constrained")
scenes = (
    ("distances to two", landmarks[:2], {"ranges": ranges[:2]}, {"sigma_range": 0.3},
     gs.trilaterate(landmarks[:2], ranges[:2], sigma=0.3)),
    ("bearings of three", landmarks, {"bearings": bearings}, {"sigma_bearing": 0.08},
     gs.triangulate(landmarks, bearings, sigma=0.08)),
)  # fmt: skip
for (left, right), (title, xy, measured, noise, fix) in zip(panels, scenes, strict=True):
    print(title, fix.explain(), sep=": ")
    gs.plots.set_view(left, extent, f"{title}: no noise")
    gs.plots.draw_solution_set(left, xy, **measured)
    gs.plots.draw_fix(left, fix, length=1.2, ellipses=False)
    gs.plots.set_view(right, extent, f"{title}: with noise")
    log_p = gs.plots.position_log_density(points, xy, **measured, **noise)
    image = gs.plots.draw_position_density(right, log_p, extent)
    gs.plots.add_colour_bar(right, image, "log p below its maximum [nats]")
    gs.plots.draw_fix(right, fix)
    for ax in (left, right):
        gs.plots.draw_beacons(ax, xy)
plt.show()
