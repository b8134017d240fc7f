"""Readings placed on the device equal the host's: choice, positions, bits and constant."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from support.kernel_scenes import on_both, scene_flags

import gpusense as gs
from gpusense.backends import Backend
from gpusense.evaluation.tolerances import differing
from gpusense.interface.constants import BLOCK_TERMS, MAX_FIXED, MAX_LEFT_OUT, MAX_PLACED
from gpusense.interface.structs import Frame, ReadingRules, Window
from gpusense.models.scan.classed import BeamSelection, choose_beams, class_scans
from gpusense.reference.scan import is_chosen
from gpusense.world.frames import ray_vectors, split
from gpusense.world.scanner import Reading

RANGE, NEAREST, RESOLUTION, GUARD = 5.0, 0.2, 0.05, 3.25 * 2.0**-23
LAST = float(np.nextafter(np.float32(RANGE), np.float32(0)))
SPECIAL = [
    np.nan, np.inf, -np.inf, RANGE, -1.0, 0.0, -0.0, 1e-300, NEAREST, 0.1, LAST, np.nextafter(RANGE, 0), 7.0,
]  # fmt: skip


def scans(real: type, count: int) -> list[np.ndarray]:
    """Return scans of only ranges, with readings of every class, and without any range."""
    rng = np.random.default_rng(count)
    plain = rng.uniform(0.3, 4.9, count)
    mixed = np.where(rng.random(count) < 0.5, rng.choice(SPECIAL, count), plain)
    return [one.astype(real) for one in (plain, mixed, np.full(count, np.nan), np.full(count, np.inf))]


def placed(
    device: Backend, flags: frozenset[str], ranges: np.ndarray, vectors: np.ndarray, *numbers: Any, some: bool = False
) -> Any:
    """Return the readings that place_inputs writes, after a comparison of reference and device; the rest stays 77."""
    real = np.float64 if "FLOAT64" in flags else np.float32
    beams, each = vectors.shape[:2]
    places, chosen, kind, possible, nearest, log_max, top = numbers
    blocks = max(-(-places // BLOCK_TERMS), 1)
    room = [np.full(max(size, 1), 77, real) for size in (2 * each * places, 2 * places, places, blocks, 1)]
    beam, head = np.arange(beams, dtype=np.int32), max(beams, places, 1)
    flags |= {"RANGES_FLOAT32"} if ranges.dtype == np.float32 else frozenset()
    if some:
        # The same readings among others.
        flags, beam = flags | {"SOME_BEAMS"}, 1 + 2 * beam
        ranges = np.insert(ranges, np.arange(beams), ranges.dtype.type(1.5))
    poses = [np.zeros(3), np.zeros(2, np.int32), np.zeros(4, real), np.zeros(4, real), np.zeros(2, np.int32)]
    frame = Frame(0.0, 0.0, RESOLUTION, 0.0, 0.0, 1.0, 0.0), Window(0, 0, 10, 10), 0
    call = (
        "place_inputs", flags, (head,), *poses, ranges, beam, vectors, *room, *frame, head,
        ReadingRules(nearest, RANGE, log_max, top, GUARD, beams, each, places, chosen, kind, possible),
    )  # fmt: skip
    reference, found = on_both(device, *call)
    for name in reference:
        assert differing(found[name], reference[name]) == 0, name
    return reference


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize(("precision", "single"), [(np.float32, True), (np.float32, False), (np.float64, False)])
@pytest.mark.parametrize("end_points", [True, False], ids=["end points", "rays"])
def test_readings_are_placed_as_the_host_prepares_them(
    end_points: bool, precision: type, single: bool, device: Backend
) -> None:
    """Try all choices of beams and all treatments of max readings."""
    real = np.dtype(precision)
    for count, (z_max, kind) in itertools.product((1, 53), ((0.0, MAX_LEFT_OUT), (0.1, MAX_FIXED), (0.1, MAX_PLACED))):
        scanner = gs.Scanner(np.linspace(-3, 3, count), RANGE, NEAREST)
        vectors = ray_vectors(scanner.bearings, scanner.mount)
        nearest = float((np.float32 if single else np.float64)(NEAREST))
        for ranges, chosen in itertools.product(scans(np.float32 if single else np.float64, count), (0, 7, 16, count)):
            chosen = min(chosen, count)
            rules = BeamSelection(scanner, vectors, z_max, chosen, True, max_depends=kind == MAX_PLACED)
            scan = class_scans(ranges[None], rules)
            flags = scene_flags(precision, *(["END_POINTS"] if end_points else []))
            numbers = (chosen, chosen, kind, 1, nearest, np.log(z_max) if z_max else 0.0, np.inf)
            found = placed(device, flags, ranges, vectors[:, None], *numbers, some=chosen == 7)
            some = len(scan.readings)
            assert found["constant_term"][0] == real.type(scan.constants[0])
            point = found["point"][: 2 * chosen].reshape(chosen, 2)
            if not end_points:
                assert differing(found["reading"][:some], scan.readings.astype(real)) == 0
                assert np.isnan(found["reading"][some:chosen]).all()
                assert differing(point[:some], scan.vectors.astype(real)) == 0
                assert (point[some:] == (1, 0)).all()
                continue
            finite = np.isfinite(scan.readings)
            lengths = np.where(finite, scan.readings, 0) / RESOLUTION
            high, low = split(scan.vectors * lengths[:, None], real)
            high[~finite] = np.inf
            assert differing(point[:some], high) == 0 and np.isnan(point[some:]).all()
            assert differing(found["point_low"][: 2 * some], low.ravel()) == 0
            for block, first in enumerate(range(0, chosen, BLOCK_TERMS)):
                longest = lengths[first : first + BLOCK_TERMS].max(initial=0)
                assert found["guard"][block] == real.type(GUARD * (longest + 2))


@pytest.mark.sampled(1)
@pytest.mark.long_on("warp")
@pytest.mark.parametrize(("precision", "single"), [(np.float32, True), (np.float32, False), (np.float64, False)])
@pytest.mark.parametrize(("end_points", "each"), [(True, 1), (False, 3)], ids=["end points", "rays"])
def test_a_scan_of_each_robot_is_placed_like_a_single_one(
    end_points: bool, each: int, precision: type, single: bool, device: Backend
) -> None:
    count, top, real = 53, float(np.float32(4.0)), np.float32 if single else np.float64
    given, blocks = np.stack(scans(real, count)), -(-count // BLOCK_TERMS)
    vectors = np.random.default_rng(6).uniform(-1, 1, (count, each, 2))
    # Beams of the model among others.
    beam, among = 1 + 2 * np.arange(count, dtype=np.int32), np.insert(given, np.arange(count), real(1.5), axis=1)
    flags = scene_flags(precision, *(["END_POINTS"] if end_points else []))
    shapes = {"point": 2 * each * count, "point_low": 2 * count, "reading": count, "guard": blocks}
    for kind in (MAX_LEFT_OUT, MAX_PLACED):
        rules = ReadingRules(float(real(NEAREST)), RANGE, 0.0, top, GUARD, count, each, count, count, kind, 1)
        reference, found = on_both(
            device, "place_scans", flags | (frozenset({"RANGES_FLOAT32"}) if single else frozenset()), (given.size,),
            among, beam, vectors, *(np.full(len(given) * size, 77, precision) for size in shapes.values()), len(given),
            among.shape[1], blocks, RESOLUTION, rules,
        )  # fmt: skip
        for scan, ranges in enumerate(given):
            numbers = (count, count, kind, 1, rules.nearest, 0.0, top)
            alone = placed(device, flags | {"ALL_READINGS"}, ranges, vectors, *numbers)
            for name, size in shapes.items():
                for placing in (reference, found):
                    part = placing[name].reshape(len(given), size)[scan]
                    assert differing(part, alone[name][:size]) == 0, (name, scan, kind)


@pytest.mark.long_on("warp")
def test_readings_that_keep_their_places(device: Backend) -> None:
    """ALL_READINGS keeps readings in place; a table's ranges stay below its last bin, cones have several vectors."""
    (_, ranges, *_), count = scans(np.float32, 53), 53
    scanner = gs.Scanner(np.linspace(-3, 3, count), RANGE, NEAREST, cone=0.2, cone_rays=3)
    vectors = ray_vectors(scanner.ray_bearings, scanner.mount)
    scan = class_scans(ranges[None], BeamSelection(scanner, vectors[:, 1], 0.1, None, False))
    top = np.float32(4.0)
    numbers = (count, count, MAX_PLACED, 1, float(np.float32(NEAREST)), 0.0, float(top))
    found = placed(device, frozenset({"ALL_READINGS"}), ranges, vectors, *numbers)
    expected = scan.readings.astype(np.float32)
    expected = np.where(np.isfinite(expected), np.minimum(expected, top), expected)
    assert differing(found["reading"], expected) == 0 and found["constant_term"][0] == 0
    assert differing(found["point"], vectors.astype(np.float32).ravel()) == 0


def test_an_even_choice_is_that_of_the_host() -> None:
    for informative, chosen in itertools.product(range(1, 40), range(42)):
        kinds = np.full(informative, Reading.HIT)
        expected = choose_beams(kinds, chosen, True)
        assert (is_chosen(np.arange(informative), informative, chosen) == expected).all()
