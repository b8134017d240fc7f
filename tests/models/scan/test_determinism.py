"""A call returns the same bits in another process and on every device."""

from __future__ import annotations

import functools
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

import gpusense as gs
from gpusense.evaluation.tolerances import TOLERANCES, beam_tolerance, scan_tolerance

KINDS = ("ranges", "beam", "field", "bilinear")
PRECISIONS = ("float32", "float64")
# 44 beams make two whole blocks and a partial block of the sum over beams; four beams repeat a bearing.
BEARINGS = np.concatenate([np.linspace(-2.2, 2.2, 40), [0.0, 0.0, 1.0, 1.0]])
RANGE, COUNT = 3.0, 301
Call = Callable[[np.ndarray], np.ndarray]


def room() -> gs.OccupancyGrid:
    rng = np.random.default_rng(0)
    return gs.OccupancyGrid(rng.choice([0, 100, -1], (120, 200), p=[0.96, 0.02, 0.02]), 0.1, (1.0, -2.0, 0.4))


def cloud(count: int = COUNT) -> np.ndarray:
    """Return poses in and around the map, off its lattice, on corners at multiples of 45 degrees, huge headings."""
    rng = np.random.default_rng(1)
    (rows, cols), third = room().shape, count // 3
    centers = room().cell_centers(rng.integers(-5, rows + 5, count), rng.integers(-5, cols + 5, count))
    poses = np.column_stack([centers + rng.uniform(-0.05, 0.05, centers.shape), rng.uniform(-4, 4, count)])
    poses[:third] = np.column_stack([np.round(centers[:third]), rng.integers(-4, 5, third) * (np.pi / 4)])
    poses[third::7, 2] += 1e6
    return poses[rng.permutation(count)]


def scans() -> np.ndarray:
    """Return five scans: all hits, some of every class, all missing, all max, a single hit."""
    rng = np.random.default_rng(2)
    z = rng.uniform(0.1, RANGE, (5, len(BEARINGS)))
    z[1, ::5], z[1, 1::7], z[1, 2::11] = np.nan, np.inf, 0.0
    z[2], z[3], z[4, 1:] = np.nan, np.inf, np.nan
    return z


def scanner() -> gs.Scanner:
    return gs.Scanner(BEARINGS, RANGE, mount=(0.2, 0.1, 0.3))


def model(kind: str, precision: str, backend: str) -> gs.BeamModel | gs.LikelihoodFieldModel:
    if kind == "beam":
        p = gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.1, 0.3)
        return gs.BeamModel(room(), scanner(), p, backend=backend, precision=precision, temperature=0.3)
    field = gs.LikelihoodFieldParameters(0.7, 0.1, 0.2, 0.15, 0.8, "bilinear" if kind == "bilinear" else "nearest")
    return gs.LikelihoodFieldModel(room(), scanner(), field, backend=backend, precision=precision, temperature=0.3)


def make(kind: str, precision: str, backend: str) -> tuple[object, Call]:
    """Return a caster or model, and its function of poses: ranges (N, K), or log p without, with parts (N, 2 + K)."""
    if kind == "ranges":
        caster = gs.RayCaster(room(), RANGE, backend=backend, precision=precision)
        return caster._caster, lambda poses: caster.cast(poses, BEARINGS)
    scored, z = model(kind, precision, backend), scans()[1]

    def score(poses: np.ndarray) -> np.ndarray:
        log_p, parts = scored.log_likelihood(poses, z, per_beam=True)
        return np.column_stack([scored.log_likelihood(poses, z), log_p, parts])

    return scored, score


# Tests share models: earlier calls must not matter.
shared = functools.cache(make)


def hashes(backend: str) -> str:
    """Return a line for each kind and precision."""
    results = {(kind, p): make(kind, p, backend)[1](cloud()) for kind in KINDS for p in PRECISIONS}
    return "".join(f"{kind} {p} {hashlib.sha256(bits.tobytes()).hexdigest()}\n" for (kind, p), bits in results.items())


@pytest.mark.long
def test_in_a_fresh_process(needs):
    """Another process orders sets of flags differently and has a single thread."""
    from support.selection import BACKENDS

    backends = [needs(backend) for backend in BACKENDS]
    alone = {"PYTHONHASHSEED": "2", "POCL_MAX_PTHREAD_COUNT": "1", "CL_CONFIG_CPU_TARGET_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", __file__, *backends]
    done = subprocess.run(command, env=os.environ | alone, capture_output=True, text=True, timeout=300)
    assert done.stdout == "".join(map(hashes, backends)), done.stderr


def real_devices() -> list[str]:
    """Return every processor and GPU; PoCL's and Intel's OpenCL for a processor are two devices."""
    return [device.selection for device in gs.devices() if device.available and device.kind != "simulator"]


def test_float32_ranges_of_every_device_have_the_same_bits():
    rays = {name: shared("ranges", "float32", name)[1](cloud(3000)) for name in real_devices()}
    exact, (truth, *others) = TOLERANCES["float32 ranges"], rays.values()
    assert [exact.difference(ranges, truth) for ranges in others] == [exact.value] * len(others)
    assert len({hashlib.sha256(ranges.tobytes()).hexdigest() for ranges in rays.values()}) == 1


@pytest.mark.parametrize("kind", KINDS[1:])
def test_log_likelihoods_of_every_device_are_within_tolerance(kind):
    """Functions such as exp differ, but sums do not: both sides are within the tolerance of the truth."""
    scores = {name: shared(kind, "float32", name)[1](cloud()) for name in real_devices()}
    truth, total, each = scores["numpy"], scan_tolerance("float32", len(BEARINGS)), beam_tolerance("float32")
    for name, found in scores.items():
        for tolerance, columns in ((total.twice(), slice(0, 2)), (each.twice(), slice(2, None))):
            assert tolerance.difference(found[:, columns], truth[:, columns]) <= tolerance.value, name


if __name__ == "__main__":
    sys.stdout.write("".join(map(hashes, sys.argv[1:])))
