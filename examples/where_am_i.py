"""Build a map from simulated scans, and localise another scan on it without a guess.

python examples/where_am_i.py [likelihood.png]
"""

import sys

import numpy as np

import gpusense as gs

# A robot drives through a building and scans it from 60 places.
building = gs.worlds.building(seed=1)
scanner = gs.Scanner.uniform(angle_min=-np.pi, angle_increment=np.pi / 180, count=360, range_max=15.0)
rng = np.random.default_rng(0)
poses = np.array([gs.worlds.free_pose(building, rng) for _ in range(61)])
scans = gs.BeamModel(building, scanner).expected_ranges(poses) + rng.normal(0.0, 0.01, (61, 360))

grid = gs.build_map(scans[:60], poses[:60], scanner, resolution=0.1)
print(grid)

# Where was the last scan taken?
model = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(), beams=180)  # AMCL's wide field
found = gs.locate_scan(model, scans[60], resolution=0.1)
print(f"truth {poses[60].round(2)}, {found.status} {found.pose.round(2)}, score {found.score:.3f}")
print(f"{found.evaluated} evaluations instead of {found.poses}; {len(found.modes)} modes")

likelihood = gs.pose_likelihood(model, scans[60], resolution=0.2, headings=36, positions="free")
print(f"entropy of the pose {likelihood.entropy:.2f} nats")
if len(sys.argv) > 1:
    likelihood.plot(sys.argv[1])
