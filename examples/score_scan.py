"""How likely is a scan, if the robot stands here? For ten thousand poses at once."""

import numpy as np

import gpusense as gs

# A room of 8 x 6 m with a pillar. Any nav_msgs/OccupancyGrid will do; gs.read_map("map.yaml") reads map_server's files.
cells = np.zeros((120, 160), dtype=np.int8)
cells[[0, -1], :] = cells[:, [0, -1]] = 100
cells[70:78, 100:108] = 100
grid = gs.OccupancyGrid(cells, resolution=0.05)

scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=12.0)
model = gs.BeamModel(grid, scanner, gs.BeamParameters(sigma_hit=0.05))

# A scan without noise from a pose that we pretend not to know, and poses all over the room.
truth = np.array([2.5, 2.0, 0.4])
ranges = model.expected_ranges(truth[None])[0]
poses = np.random.default_rng(0).uniform((0.1, 0.1, -np.pi), (7.9, 5.9, np.pi), size=(10_000, 3))
poses = np.vstack([poses, truth])

log_p = model.log_likelihood(poses, ranges)
print("the best pose is", poses[np.argmax(log_p)], "with log P(z | x, m) =", log_p.max())
print(model.explain())
