"""Scanner geometry and the classes of readings."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest

from gpusense.world.scanner import Reading, Scanner, classify

MISSING, MAX, HIT = Reading.MISSING, Reading.MAX, Reading.HIT


def scanner_of(count, range_max=5.0, range_min=0.0):
    return Scanner(np.zeros(count), range_max, range_min)


def test_uniform_beams_are_not_accumulated():
    scanner = Scanner.uniform(angle_min=-1.0, angle_increment=0.1, count=21, range_max=30.0, range_min=0.1)
    assert scanner.bearings.tolist() == [-1.0 + 0.1 * k for k in range(21)]
    assert (scanner.count, scanner.range_max, scanner.range_min) == (21, 30.0, 0.1)
    assert scanner.mount == (0.0, 0.0, 0.0)


def test_no_beams_are_legal():
    assert Scanner([], 5.0).count == 0
    assert Scanner.uniform(angle_min=0, angle_increment=0.1, count=0, range_max=5.0).count == 0
    assert classify([], Scanner([], 5.0)).shape == (0,)
    assert classify(np.empty((3, 0)), Scanner([], 5.0)).shape == (3, 0)


def test_bearings_are_an_own_read_only_copy():
    source = np.array([0.0, 1.0])
    scanner = Scanner(source, 5.0)
    source[0] = 7.0
    assert scanner.bearings.tolist() == [0.0, 1.0]
    with pytest.raises(ValueError, match="read-only"):
        scanner.bearings[0] = 1.0
    with pytest.raises(AttributeError):
        scanner.range_max = 1.0


def test_equality_and_hash_are_by_value():
    scanner = Scanner([0.0, 1.0], 5.0, 0.1, (1, 2, 3))
    same = Scanner(np.array([-0.0, 1.0]), 5, 0.1, [1.0, 2.0, 3.0])
    assert scanner == same
    assert hash(scanner) == hash(same)
    assert len({scanner, same}) == 1
    others = [
        Scanner([0.0, 1.1], 5.0, 0.1, (1, 2, 3)),
        Scanner([0.0, 1.0], 6.0, 0.1, (1, 2, 3)),
        Scanner([0.0, 1.0], 5.0, 0.2, (1, 2, 3)),
        Scanner([0.0, 1.0], 5.0, 0.1, (1, 2, 4)),
        "scanner",
    ]
    assert all(scanner != other for other in others)


@pytest.mark.parametrize("twin", [copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_are_equal_and_read_only(twin):
    scanner = Scanner([0.0, 1.0], 5.0, 0.1, (1, 2, 3))
    assert twin(scanner) == scanner
    assert not twin(scanner).bearings.flags.writeable


@pytest.mark.parametrize(
    ("z", "from_zero", "from_half"),
    [
        (math.nan, MISSING, MISSING),
        (-math.inf, MISSING, MISSING),
        (-1.0, MISSING, MISSING),
        (-5e-324, MISSING, MISSING),
        (-0.0, HIT, MISSING),
        (0.0, HIT, MISSING),
        (0.25, HIT, MISSING),
        (math.nextafter(0.5, 0), HIT, MISSING),
        (0.5, HIT, HIT),
        (math.nextafter(5.0, 0), HIT, HIT),
        (5.0, MAX, MAX),
        (6.0, MAX, MAX),
        (math.inf, MAX, MAX),
    ],
)
def test_the_table_of_readings(z, from_zero, from_half):
    assert classify([z], scanner_of(1)).tolist() == [from_zero]
    assert classify([z], scanner_of(1, range_min=0.5)).tolist() == [from_half]


def test_kinds_are_small_and_keep_the_shape():
    kinds = classify([[1.0, 9.0], [math.nan, 2.0]], scanner_of(2))
    assert kinds.dtype == np.uint8
    assert kinds.tolist() == [[HIT, MAX], [MISSING, HIT]]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
@pytest.mark.parametrize("range_max", [81.91, 30.01, 0.1])
def test_range_max_is_recognised_in_the_readings_own_dtype(dtype, range_max):
    limit = np.array(range_max, dtype=dtype)
    below = np.nextafter(limit.astype(limit.dtype.newbyteorder("=")), np.array(0, limit.dtype.newbyteorder("=")))
    kinds = classify(np.array([limit, below], dtype=dtype), scanner_of(2, range_max))
    assert kinds.tolist() == [MAX, HIT]


def test_limits_beyond_the_dtype():
    # 1e6 is infinite in float16, 1e-50 is 0 in float32: the rules still hold.
    assert classify(np.float16([1.0, 65504.0, np.inf]), scanner_of(3, 1e6)).tolist() == [HIT, HIT, MAX]
    assert classify(np.float32([0.0, 1e-40]), scanner_of(2, 5.0, 1e-50)).tolist() == [MISSING, HIT]


def test_integers_become_float64():
    assert classify([0, 4, 5], scanner_of(3, range_min=1)).tolist() == [MISSING, HIT, MAX]
    assert classify(np.array([81, 82], np.uint8), scanner_of(2, 81.91)).tolist() == [HIT, MAX]
