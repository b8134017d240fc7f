"""
The likelihood field
====================

The likelihood field asks how far the end of each reading is from the nearest obstacle (book section 6.4), and needs
no rays; Z is the largest range:

.. math:: p(z \\mid x, m) = z_{hit}\\, N(d; 0, \\sigma^2) + z_{rand} / Z

The distances are computed once for a map, exactly. Left: the map with a scan at its true pose. Right: the field with
the end points of the scan, at the true pose and at one that is off by 0.5 m and 10 degrees. **Try:**
``sigma_hit=0.5``, which forgives more and distinguishes less.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

grid = gs.worlds.building(size=(14.0, 12.0), seed=2)
scanner = gs.Scanner(np.radians(np.arange(-120, 121, 3)), range_max=10.0)
parameters = gs.LikelihoodFieldParameters(z_hit=0.9, z_rand=0.1, sigma_hit=0.2)
random = np.random.default_rng(5)
truth = np.array(gs.worlds.free_pose(grid, random))
ranges = gs.BeamModel(grid, scanner, gs.BeamParameters(sigma_hit=0.03), backend="numpy").sample(truth[None])[0]
off = truth + np.array([0.5, 0.0, np.radians(10)])


def ends(pose):
    """Return the x and the y of the end points of the scan at a pose [m]."""
    hit, angles = ranges < scanner.range_max, pose[2] + scanner.bearings
    return pose[0] + (ranges * np.cos(angles))[hit], pose[1] + (ranges * np.sin(angles))[hit]


model = gs.LikelihoodFieldModel(grid, scanner, parameters)
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
gs.plots.draw_map(left, grid)
gs.plots.draw_scan(left, grid, scanner, truth, ranges)
left.set_title("map and scan")
image = gs.plots.draw_likelihood_field(right, grid, parameters, range_max=scanner.range_max)
gs.plots.add_colour_bar(right, image, "log p(end point) [nats]")
for pose, colour, name in ((truth, "#009e73", "true pose"), (off, "#d55e00", "off by 0.5 m and 10 degrees")):
    log_p = model.log_likelihood(pose[None], ranges)[0]
    right.plot(*ends(pose), "o", ms=3, color=colour, label=f"{name}: log p = {log_p:.0f}")
right.set_title("likelihood field")
gs.plots.add_legend(right, 2)
plt.show()
