"""
Features of a scan
==================

A few hundred readings become a handful of features: lines, and the corners, doors and poles that they make, each with a
covariance (book section 6.6; Siegwart, Nourbakhsh and Scaramuzza 2011, chapter 4). ``gs.extract_features`` finds them,
and a landmark model compares them with a map of features. A scan's features are few, so they are matched easily; they
lose all that has no name. **Try:** ``count=181``, or ``gs.BeamParameters(sigma_hit=0.05)`` for a noisier laser.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpusense as gs

grid = gs.worlds.building(size=(20.0, 14.0), seed=4)
scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=4.0 / 720, count=721, range_max=10.0)
pose = np.array(gs.worlds.free_pose(grid, np.random.default_rng(6)))
parameters = gs.BeamParameters(z_hit=0.98, z_short=0.0, z_max=0.01, z_rand=0.01, sigma_hit=0.01)
ranges = gs.BeamModel(grid, scanner, parameters).sample(pose[None], seed=0)[0]

features = gs.extract_features(ranges, scanner)
print({kind: len(features[kind]) for kind in ("line", "corner", "door", "hallway", "pole") if len(features[kind])})

figure, ax = plt.subplots(figsize=(8, 6), layout="constrained")
gs.plots.draw_features(ax, features, ranges, scanner)
ax.set_title(f"{(ranges < scanner.range_max).sum()} end points, {len(features)} features")
gs.plots.add_legend(ax, 6)
plt.show()
