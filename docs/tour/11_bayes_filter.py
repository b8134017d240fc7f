"""
A Bayes filter follows a robot
==============================

A particle filter moves particles by the odometry, weighs them by the scan and draws new ones (book sections 4.3 and
8.3). Odometry alone drifts; the filter begins with a vague guess and follows the robot. **Try:**
``pf.initialize_uniform()`` with 20 000 particles, or ``hidden=0.5``, a crowd.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

grid = gs.worlds.building(seed=1)
scanner = gs.Scanner(np.radians(np.arange(-90, 91, 3)), range_max=12.0)
run = gs.worlds.simulate_run(grid, scanner, scans=150, hidden=0.2, seed=6)

model = gs.LikelihoodFieldModel(grid, scanner)
pf = gs.ParticleFilter(model, particles=1000, seed=0)
pf.initialize(mean=run.poses[0] + (0.4, -0.3, 0.2), covariance=np.diag([0.25, 0.25, 0.1]))
poses, clouds = [], {}
for k, ranges in enumerate(run.scans):
    if k:
        pf.predict(run.odometry[k - 1], run.odometry[k])
    if k in (0, 40):
        clouds[k] = np.array(pf.particles)
    pf.correct(ranges)
    poses.append(pf.estimate().pose)
poses = np.array(poses)
errors = np.hypot(*(poses - run.poses)[:, :2].T)
print(f"median error {np.median(errors):.3f} m, largest {errors.max():.2f} m; {pf.estimate().verdict}")

# Odometry from the true start, for comparison.
odometry = gs.compose_poses(run.poses[0], gs.pose_difference(run.odometry[0], run.odometry))
figure, ax = plt.subplots(figsize=(10, 6.5), layout="constrained")
gs.plots.draw_map(ax, grid)
ax.plot(*run.poses[:, :2].T, "k", lw=3, label="truth")
ax.plot(*odometry[:, :2].T, "--", color="#d55e00", label="odometry alone")
ax.plot(*poses[:, :2].T, color="#56b4e9", lw=1.5, label="filter")
for k, cloud in clouds.items():
    ax.plot(*cloud[:, :2].T, ".", ms=1.5, color="#009e73", label=f"particles before scan {k + 1}")
ax.set_title(f"150 scans, a fifth of the beams hidden by people; median error {100 * np.median(errors):.1f} cm")
gs.plots.add_legend(ax, 5)
plt.show()
