"""Describe a floor plan by the rays of every free cell at several headings, in one call.

    python examples/many_worlds/floor_plan.py [--plans 4] [--headings 16] [--rays 20]

Localisation on floor plans compares an image's predicted ranges with such a table. Descriptors are half the size in
float16.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import gpusense as gs


def descriptors(
    worlds: gs.Worlds, headings: int, bearings: np.ndarray, range_max: float, every: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rays of free cells of all plans.

    Args:
        worlds: The floor plans.
        headings: Number of headings A, evenly around.
        bearings: (K,) bearings of a descriptor's rays [rad].
        range_max: Longest range [m].
        every: Take every n-th cell along rows and columns.

    Returns:
        (N,) indices of the plans, (N, 3) poses, and (N, K) ranges.
    """
    plans, poses = [], []
    turns = 2 * np.pi * np.arange(headings) / headings
    for index in range(len(worlds)):
        grid = worlds.grid(index)
        rows, cols = (each * every for each in np.nonzero(grid.free[::every, ::every]))
        centres = grid.cell_centers(rows, cols)
        poses.append(np.column_stack([centres.repeat(headings, axis=0), np.tile(turns, len(centres))]))
        plans.append(np.full(len(poses[-1]), index))
    where, places = np.concatenate(plans), np.concatenate(poses)
    ranges = gs.RayCaster(worlds, range_max, backend=worlds.backend).cast(places, bearings, world=where)
    return where, places, ranges


def main() -> None:
    """Describe generated buildings, and find a scan in them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--plans", type=int, default=4)
    parser.add_argument("--headings", type=int, default=16)
    parser.add_argument("--rays", type=int, default=20)
    arguments = parser.parse_args()
    grids = [gs.worlds.building(seed) for seed in range(arguments.plans)]
    worlds = gs.Worlds(grids, backend=arguments.backend)
    bearings = np.linspace(-0.7, 0.7, arguments.rays)
    begin = time.perf_counter()
    where, poses, ranges = descriptors(worlds, arguments.headings, bearings, 15.0, every=10)
    seconds = time.perf_counter() - begin
    print(f"{ranges.size} rays of {arguments.plans} plans in {seconds:.2f} s on {worlds.device.selection}")
    truth = len(poses) // 3
    scan = ranges[truth] + np.random.default_rng(0).normal(0, 0.02, len(bearings))
    found = np.abs(ranges - scan).sum(axis=1).argmin()
    print(f"plan {where[truth]}, pose {poses[truth].round(2)}: found plan {where[found]}, pose {poses[found].round(2)}")


if __name__ == "__main__":
    main()
