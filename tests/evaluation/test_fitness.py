"""The judgement of a log's poses is the same on devices that cannot judge beams."""

import copy
import dataclasses

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.scoring import FitnessOfLog

GRID = gs.worlds.building(2, (20.0, 20.0))
SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=4.0 / 59, count=60, range_max=10.0)


def judged(device: object, scans: list[gs.Scan]) -> object:
    """Return the judgement of scans by a field on a device."""
    fitness = FitnessOfLog(gs.LikelihoodFieldModel(GRID, SCANNER, backend=device))
    for scan in scans:
        fitness.add(scan, 1.0)
    return fitness.result()


def test_a_device_without_float64_judges_a_log_as_others(needs):
    device = get_backend(needs("opencl"))
    poses = np.array([gs.worlds.free_pose(GRID, np.random.default_rng(seed), 0.3) for seed in range(3)])
    ranges = gs.BeamModel(GRID, SCANNER, backend="numpy").sample(poses, seed=1)
    scans = [
        gs.Scan(float(i), z.astype(np.float64), SCANNER, (0.0, 0.0, 0.0), tuple(map(float, pose)))
        for i, (z, pose) in enumerate(zip(ranges, poses, strict=True))
    ]
    single = copy.copy(device)
    single.info = dataclasses.replace(device.info, float64=False)
    single._launchers = {}
    found = judged(single, scans)
    assert found.scans == 3 and found.explained > 0.8
    assert found == judged(device, scans)
