"""Kernels that score several scans in one launch agree with the reference, scan by scan."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.kernel_scenes import (
    EXACT,
    LASER,
    NO_CROWD,
    SCALE,
    assert_near,
    nothing,
    on_both,
    one_world,
    planes_of,
    scene_flags,
)
from support.score_scenes import (
    OCCUPIED,
    RANGE,
    WINDOW,
    an_order,
    field_scene,
    guards_of,
    items,
    mixture,
    poses,
    rays_of,
    room_for,
    scan,
)

from gpusense.backends import Backend
from gpusense.evaluation.tolerances import differing, per_beam, per_scan
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.interface.structs import ScanBatch, Score, Window
from gpusense.reference.error_free import strands_in

PER_SCAN, SCANS = 37, 4
COUNT = PER_SCAN * SCANS
# Rays or end points of each scan: less than a block, none, several blocks, one block.
START = np.array([0, 5, 5, 48, 64], np.int32)
FIXED = (-1.5, 0.25, 3.0, -2.0)
# Particles of the first scans that belong to another launch.
AHEAD = (0, 1, PER_SCAN, PER_SCAN + 5)
REAL = np.float32


def readings_of(first: np.ndarray, shared: bool) -> tuple[np.ndarray, int]:
    """Return the number of readings of each scan, and the largest."""
    counts = np.diff(first[START] if shared else START).astype(np.int32)
    return counts, int(counts.max())


def field(names: tuple[str, ...]) -> tuple[list[np.ndarray], frozenset[str], Window]:
    """Return the first arguments of both kernels of the field, the flags, and the window."""
    scene = field_scene("log table", REAL, all_readings=False)
    some = np.resize(np.arange(150), COUNT)
    scene |= {key: scene[key][some] for key in ("pose_cell", "pose", "pose_low")}
    names_of = ("pose_cell", "pose", "pose_low", "point", "point_low", "terms")
    given = [scene["table"], *one_world(REAL), *(scene[key] for key in names_of)]
    rows, cols = scene["table"].shape
    return (
        given,
        scene_flags(REAL, "LOG_TABLE", "LINEAR", "HIT", "TWO_PART_POINTS", "SCANS", *names),
        Window(0, 0, rows - 4, cols - 4),
    )


@pytest.mark.parametrize("ahead", AHEAD)
def test_fields_of_scans(ahead: int, device: Backend) -> None:
    given, flags, window = field(())
    given[3:6] = [each[ahead:] for each in given[3:6]]
    count, most = COUNT - ahead, int(np.diff(START).max())
    guard = float(guards_of(given[6]).max())
    reference, found = on_both(
        device, "score_field", flags, (count,), *given, START, np.array(FIXED, REAL), np.full(count, np.nan, REAL),
        nothing(REAL), window, count, most, guard, Score(0.0, 0.75),
        ScanBatch(PER_SCAN, ahead), NO_CROWD,
    )  # fmt: skip
    assert differing(found["log_p"], reference["log_p"]) == 0
    # The scan without readings has its constant term.
    empty = slice(max(PER_SCAN - ahead, 0), 2 * PER_SCAN - ahead)
    assert (found["log_p"][empty] == REAL(0.75) * REAL(FIXED[1])).all()


@pytest.mark.parametrize("spread", [0, 2])
@pytest.mark.parametrize("names", [(), ("ROUNDED_CELLS",)])
def test_blocks_of_fields_of_scans(names: tuple[str, ...], spread: int, device: Backend) -> None:
    given, flags, window = field(names)
    most = int(np.diff(START).max())
    blocks = -(-most // BLOCK_TERMS)
    guards = np.full(SCANS * blocks, guards_of(given[6]).max(), REAL)
    reference, found = on_both(
        device, "field_blocks", flags, items(COUNT, spread, 64, 64), *given, guards, START,
        room_for(COUNT, blocks, REAL), window, COUNT, most, spread, ScanBatch(PER_SCAN, 0), NO_CROWD,
    )  # fmt: skip
    # Each particle has only the blocks of its scan.
    assert differing(found["parts"], reference["parts"]) == 0
    written = np.count_nonzero(found["parts"].reshape(-1)[: COUNT * blocks].reshape(blocks, COUNT) != -77, axis=0)
    assert (
        written.reshape(SCANS, PER_SCAN)[:, 0].tolist() == [1, 0, 3, 1] and (np.diff(written) == 0).sum() == COUNT - 4
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("names", [(), ("ORDERED",), ("CUBES",), ("STRANDED",)])
@pytest.mark.parametrize("block", [1, BLOCK_TERMS])
def test_sums_of_scans(block: int, names: tuple[str, ...], device: Backend) -> None:
    counts = np.array([5, 0, 48, 16], np.int32)
    parts = np.random.default_rng(4).uniform(0.1, 3, 48 * COUNT).astype(REAL)
    # Ignore parts beyond the end of a scan.
    place_scan = (an_order(COUNT) if "ORDERED" in names else np.arange(COUNT)) // PER_SCAN
    added = strands_in(counts) if "STRANDED" in names else counts
    parts.reshape(48, COUNT)[np.arange(48)[:, None] >= added[place_scan]] = np.nan
    reference, found = on_both(
        device, "sum_parts", scene_flags(REAL, "SCANS", *names), (COUNT,), parts, an_order(COUNT), counts,
        np.array(np.abs(FIXED), REAL), np.full(COUNT, np.nan, REAL), COUNT, 48, block, Score(0.0, 0.75),
        ScanBatch(PER_SCAN, 0),
    )  # fmt: skip
    assert not np.isnan(found["log_p"]).any()
    np.testing.assert_allclose(found["log_p"], reference["log_p"], rtol=1e-6 if "CUBES" in names else 0)


def beams(names: tuple[str, ...]) -> tuple[frozenset[str], list[Any], np.ndarray, int]:
    """Return flags, arrays from rays to the sensor's table, the number of readings of each scan, and the largest."""
    flags, terms = mixture("book", REAL, z_max=0.05)
    repeats = np.ones(START[-1], int)
    if "SHARED_RAYS" in names:
        repeats[::3], repeats[1::5] = 3, 0
    first = np.append(0, np.cumsum(repeats)).astype(np.int32)
    reading = scan(np.linspace(0, RANGE, first[-1]), REAL, all_readings=False)
    counts, most = readings_of(first, "SHARED_RAYS" in names)
    arrays = [rays_of(int(START[-1]), REAL), first, reading, terms, *[nothing(REAL)] * 3, START]
    return scene_flags(REAL, "ORIGINS_OUTSIDE", "SCANS", *flags, *names), arrays, counts, most


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("names", [(), ("SHARED_RAYS",)])
def test_beams_of_scans(names: tuple[str, ...], device: Backend) -> None:
    flags, arrays, counts, most = beams(names)
    rays = int(np.diff(START).max())
    for ahead in AHEAD:
        cell, pose = (each[ahead:] for each in poses(COUNT, REAL))
        count = COUNT - ahead
        reference, found = on_both(
            device, "score_beams", flags, (count,), planes_of(OCCUPIED), *one_world(REAL),
            nothing(REAL, 2), cell, pose, *arrays,
            np.array(FIXED, REAL), np.full(count, np.nan, REAL), nothing(REAL), WINDOW, count, rays, most,
            *LASER, EXACT, SCALE, NO_CROWD, Score(0.0, 0.75), ScanBatch(PER_SCAN, ahead),
        )  # fmt: skip
        expected = reference["log_p"].astype(np.float64)
        bound = 2 * per_scan(np.full((count, max(most, 1)), 10.0), REAL, fixed=3.0, temperature=0.75)
        assert_near(found["log_p"], expected, bound)
        assert np.ptp(expected) > 10 and counts.min() == 0


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("names", [("ORDERED",), ("ORDERED", "SHARED_RAYS"), ("ORDERED", "STRANDED")])
def test_tiles_of_beams_of_scans(names: tuple[str, ...], device: Backend) -> None:
    flags, arrays, counts, most = beams(names)
    (cell, pose), rays, order = poses(COUNT, REAL), int(np.diff(START).max()), an_order(COUNT)
    each, added = (strands_in(most), strands_in(counts)) if "STRANDED" in names else (most, counts)
    for spread in (0, 3):
        reference, found = on_both(
            device, "beam_tiles", flags, items(COUNT, spread), planes_of(OCCUPIED), *one_world(REAL),
            nothing(REAL, 2), cell, pose, order,
            *arrays, room_for(COUNT, each, REAL), WINDOW, COUNT, rays, most, *LASER, EXACT, SCALE, NO_CROWD, spread,
            ScanBatch(PER_SCAN, 0),
        )  # fmt: skip
        expected = reference["parts"].astype(np.float64)
        assert_near(found["parts"], expected, 8 * per_beam(expected, REAL))
        written = (found["parts"].reshape(-1)[: COUNT * each].reshape(each, COUNT) != -77).sum(axis=0)
        assert (written == added[order // PER_SCAN]).all()
