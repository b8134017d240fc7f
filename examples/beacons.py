"""Locate a robot from ranges and bearings of beacons, and draw the solutions."""

import sys

import numpy as np

import gpusense as gs

# Beacons, and a robot's measurements of them at a pose that the functions below do not know.
beacons = np.array([(1.0, 1.0), (8.0, 2.0), (4.5, 7.0)])
truth = np.array([4.0, 3.5, 0.6])
offset = beacons - truth[:2]
ranges = np.hypot(offset[:, 0], offset[:, 1])
bearings = np.arctan2(offset[:, 1], offset[:, 0]) - truth[2]
sigma_range, sigma_bearing = 0.3, 0.08

scenes = {
    "Distances only": (
        2,
        gs.trilaterate(beacons[:2], ranges[:2], sigma=sigma_range),
        {"ranges": ranges},
        {"sigma_range": sigma_range},
    ),
    "Bearings only": (
        3,
        gs.triangulate(beacons, bearings, sigma=sigma_bearing),
        {"bearings": bearings},
        {"sigma_bearing": sigma_bearing},
    ),
    "Distances and bearings": (
        2,
        gs.locate(beacons[:2], ranges[:2], bearings[:2], sigma_range=sigma_range, sigma_bearing=sigma_bearing),
        {"ranges": ranges, "bearings": bearings},
        {"sigma_range": sigma_range, "sigma_bearing": sigma_bearing},
    ),
}

extent = (-1.0, 10.0, -3.0, 8.0)
points = gs.plots.tile_centers(extent, 300)
figure = gs.plots.new_figure(12.6, 7.8)
axes = figure.subplots(2, 3)
for (certain, uncertain), (title, (count, fix, measured, noise)) in zip(axes.T, scenes.items(), strict=True):
    measured = {name: values[:count] for name, values in measured.items()}
    gs.plots.set_view(certain, extent, f"{title}, no uncertainty")
    gs.plots.draw_solution_set(certain, beacons[:count], **measured)
    log_p = gs.plots.position_log_density(points, beacons[:count], **measured, **noise)
    gs.plots.set_view(uncertain, extent, f"{title}, with uncertainty")
    image = gs.plots.draw_position_density(uncertain, log_p, extent)
    gs.plots.add_colour_bar(uncertain, image, "log p(z | x, y) below its maximum [nats]")
    for ax in (certain, uncertain):
        gs.plots.draw_beacons(ax, beacons[:count])
    gs.plots.draw_fix(certain, fix, length=1.2, ellipses=False)
    gs.plots.draw_fix(uncertain, fix)
    print(f"{title}: {fix.explain()}")
    for solution, covariance in zip(fix.solutions, fix.covariance, strict=True):
        print("   ", solution.round(3), "+-", np.sqrt(np.diag(covariance)).round(3))

path = sys.argv[1] if len(sys.argv) > 1 else "beacons.png"
gs.plots.save(figure, path)
print("written:", path)
