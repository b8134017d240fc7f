"""Files of pages that no command makes: a bag with two lasers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from support.bags import BASE, LASER, Writer

import gpusense as gs
from gpusense.evaluation.trajectory_files import write_tum

SCANS, BEAMS, FIRST, STEP = 30, 61, -1.5, 0.05


def write_two_lasers(grid: gs.OccupancyGrid, folder: Path) -> np.ndarray:
    """Write ``run.bag`` with lasers on /scan, /front and /rear, and ``true.tum``; return the true poses."""
    scanner = gs.Scanner.uniform(angle_min=FIRST, angle_increment=STEP, count=BEAMS, range_max=20.0)
    run = gs.worlds.simulate_run(grid, scanner, scans=SCANS)
    turned = run.poses + np.array([0.0, 0.0, np.pi])
    rear = gs.worlds.simulate_run(grid, scanner, path=turned, seed=1).scans
    with Writer(folder, "ros1") as bag:
        bag.transform(0.0, BASE, LASER, (0.0, 0.0), 0.0)
        bag.transform(0.0, BASE, "rear", (0.0, 0.0), np.pi)
        for time, odometry, *scans in zip(run.times, run.odometry, run.scans, run.scans, rear, strict=True):
            bag.odometry(time, *odometry)
            for topic, ranges, frame in zip(("/scan", "/front", "/rear"), scans, (LASER, LASER, "rear"), strict=True):
                bag.scan(time, ranges, FIRST, STEP, topic, frame, range_max=20.0)
    write_tum(folder / "true.tum", run.times.tolist(), run.poses)
    return run.poses
