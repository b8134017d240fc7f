"""
Match a local map to a global one
=================================

A few scans make a local map, and its correlation with the global map finds the place (book section 6.5).
``gs.match_map`` searches the whole map by branch and bound, so it needs no guess. **Try:** 3 scans in place of 15.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

grid = gs.worlds.building(size=(20.0, 14.0), seed=4)
scanner = gs.Scanner(np.radians(np.arange(-120, 121, 2)), range_max=8.0)
run = gs.worlds.simulate_run(grid, scanner, scans=15, seed=2)
start = run.poses[0]
local = gs.build_map(run.scans, gs.pose_difference(start, run.poses), scanner, resolution=grid.resolution)

match = gs.match_map(local, grid)
print(match)
print("off by", (np.asarray(match.pose) - start).round(3), "m, m, rad")

rows, cols = np.nonzero(local.occupied)
x, y = local.cell_centers(rows, cols).T
cos, sin = np.cos(match.pose[2]), np.sin(match.pose[2])

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
gs.plots.draw_map(left, local)
left.set_title("local map, in the frame of its first pose")
gs.plots.draw_map(right, grid)
right.plot(match.pose[0] + cos * x - sin * y, match.pose[1] + sin * x + cos * y, ".", ms=3, color="#d55e00")
gs.plots.draw_pose(right, start, length=0.0)
right.set_title("its obstacles in the global map; ring: the true start")
plt.show()
