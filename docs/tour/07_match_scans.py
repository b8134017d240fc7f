"""
Match a scan to an earlier one
==============================

How did the robot move between two scans? ``gs.match_scan`` lays the second over the first: points to lines, with a
wide covariance and a status for directions that the scans do not determine (book section 6.5 matches maps; Censi,
ICRA 2008, is the source of this method). Right: in a map the gradient of the likelihood field points to the pose from
positions around it (book section 6.4). **Try:** a guess of (1.5, 0, 1), from which no match is found, and read
``match.explain()``.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

grid = gs.worlds.building(seed=3)
scanner = gs.Scanner(np.radians(np.arange(-120, 121)), range_max=12.0)
run = gs.worlds.simulate_run(grid, scanner, scans=30, step=0.3, seed=3)
first, second = run.scans[10], run.scans[11]
truth = gs.pose_difference(run.poses[10], run.poses[11])
guess = truth + np.array([0.25, -0.2, 0.15])

match = gs.match_scan(first, second, scanner, guess)
deviations = np.sqrt(np.diag(match.covariance))
print(match.explain())
print("off by", (match.pose - truth).round(4), "m, m, rad; deviations", deviations.round(4))


def points(ranges, pose=(0.0, 0.0, 0.0)):
    """Return x and y of the end points of a scan [m]."""
    hit, angles = ranges < scanner.range_max, pose[2] + scanner.bearings
    return pose[0] + (ranges * np.cos(angles))[hit], pose[1] + (ranges * np.sin(angles))[hit]


# The gradient of the likelihood field at positions around the true one, at the true heading.
field = gs.LikelihoodFieldModel(
    grid, scanner, gs.LikelihoodFieldParameters(sigma_hit=0.15, interpolation="bilinear"), temperature=0.1
)
dx, dy = np.meshgrid(np.linspace(-0.4, 0.4, 13), np.linspace(-0.4, 0.4, 13))
around = run.poses[11] + np.column_stack([dx.ravel(), dy.ravel(), np.zeros(dx.size)])
log_p, gradient, _ = field.gradient(around, second)

figure, panels = plt.subplots(1, 3, figsize=(14, 4.5), layout="constrained")
for ax, pose, title in zip(panels, (guess, match.pose), ("at the guess", "matched"), strict=False):
    ax.plot(*points(first), "o", ms=4, color="#0072b2", label="first scan")
    ax.plot(*points(second, pose), ".", ms=4, color="#d55e00", label="second scan")
    ax.set(title=title, xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(-3, 8), ylim=(-5, 3))
    gs.plots.add_legend(ax)
image = panels[2].pcolormesh(dx, dy, log_p.reshape(dx.shape) - log_p.max(), cmap=gs.plots.colours(), shading="nearest")
panels[2].quiver(dx, dy, *gradient[:, :2].T, color="#d55e00", pivot="tail")
panels[2].set(title="gradient in a map", xlabel="x from the truth [m]", ylabel="y from the truth [m]", aspect="equal")
figure.colorbar(image, ax=panels[2], label="log p below its maximum [nats]", shrink=0.8)
plt.show()
