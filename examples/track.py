"""Track a robot that drives through a generated building, with a particle filter.

python examples/track.py [--backend opencl] [--particles 500]
"""

from __future__ import annotations

import argparse

import numpy as np

import gpusense as gs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--particles", type=int, default=500)
    args = parser.parse_args()

    rng = np.random.default_rng(0)
    cells = np.pad(np.zeros((120, 160), int), 2, constant_values=100)
    cells[60:64, :70] = cells[30:34, 90:] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.1)
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 90, count=91, range_max=20.0)
    caster = gs.RayCaster(grid, range_max=20.0, backend=args.backend)
    model = gs.BeamModel(grid, scanner, gs.BeamParameters(sigma_hit=0.05), backend=args.backend)

    pf = gs.ParticleFilter(model, particles=args.particles, seed=1)
    truth, odometry = np.array([2.0, 2.0, 0.1]), np.zeros(3)
    pf.initialize(mean=truth, covariance=np.diag([0.25, 0.25, 0.07]))
    for step in range(30):
        motion = np.array([0.3, 0.0, 0.05 if step % 10 < 5 else -0.05])
        before, odometry = odometry, gs.compose_poses(odometry, motion)
        truth = gs.compose_poses(truth, motion + rng.normal(0, [0.02, 0.005, 0.01]))
        ranges = caster.cast(truth[None], scanner.bearings)[0] + rng.normal(0, 0.03, scanner.count)
        pf.predict(before, odometry)
        pf.correct(ranges)
        found = pf.estimate()
        if step % 5 == 4:
            error = np.hypot(*(found.pose - truth)[:2])
            print(f"step {step + 1}: error {error:.3f} m, {found!r}")


if __name__ == "__main__":
    main()
