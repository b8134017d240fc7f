"""
Where could this scan come from?
================================

P(z | x, m) at all poses of a map, drawn at the best heading of each position: the darker, the likelier. Nothing is
known before but the map; the sum over a grid of poses is the first step of grid localisation (book section 8.2). The
likelihood field does not ask whether a wall stands between the robot and the end of a beam, so other places can score
nearly the same. **Try:** ``default_rng(2)``, a scan for which a wrong place is the likeliest, and ``beams=8``; or
`drag a scanner over a map <../../figures/scan.html>`__ in the browser.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

grid = gs.worlds.building(size=(20.0, 14.0), seed=4)
scanner = gs.Scanner(np.radians(np.arange(-90, 91, 2)), range_max=8.0)
random = np.random.default_rng(6)
truth = np.array(gs.worlds.free_pose(grid, random))
ranges = gs.BeamModel(grid, scanner, gs.BeamParameters(sigma_hit=0.03), backend="numpy").sample(truth[None])[0]

model = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(sigma_hit=0.15), beams=45)
likelihood = gs.pose_likelihood(model, ranges, resolution=0.1, headings=72)
print(likelihood.log_p.shape, "rows, columns and headings; entropy", round(likelihood.entropy, 2), "nats")
best, log_p = likelihood.modes()
for pose, value in zip(best[:3], log_p[:3], strict=True):
    print("likely:", pose.round(2), f"log P(z | x, m) = {value:.1f}; truth:", truth.round(2))

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.4), layout="constrained")
gs.plots.draw_map(left, grid)
gs.plots.draw_scan(left, grid, scanner, truth, ranges)
left.set_title("the scan at its true pose")
gs.plots.draw_map(right, grid)
image = gs.plots.draw_pose_likelihood(right, likelihood)
gs.plots.add_colour_bar(right, image, "log P(z | x, m) below its maximum [nats]")
gs.plots.draw_pose(right, truth, length=0.0)
right.set_title("every position at its best heading; ring: the truth")
plt.show()
