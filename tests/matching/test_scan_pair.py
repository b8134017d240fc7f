"""A match of a single pair, prepared on the device, equals a match among several pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from support.matching_scenes import CORRIDOR, FRONT, RING, ROOM, random_pairs, segments_scan

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import MATCH_RESULT
from gpusense.matching.icp import space_of
from gpusense.matching.options import check_options
from gpusense.matching.points import match_noise, noise_levels, scan_noise, scan_points
from gpusense.matching.scan_pair import _program, _Scene

MOUNTED = gs.Scanner(FRONT.bearings, 30.0, 0.1, (0.2, 0.05, 0.3))
DENSE = gs.Scanner(np.linspace(-2.0, 2.0, 1081), 30.0)


def scans(scanner: gs.Scanner, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return two noisy scans of a room."""
    rng = np.random.default_rng(seed)
    poses = (0.0, 0.0, 0.0), (0.15, -0.1, 0.08)
    first, second = (segments_scan(ROOM, pose, scanner) + noise * rng.normal(size=scanner.count) for pose in poses)
    return first, second


def damaged(change: Callable[[np.ndarray], None]) -> tuple[np.ndarray, np.ndarray]:
    """Return two scans after a change of each."""
    pair = scans(RING, 0.01)
    for scan in pair:
        change(scan)
    return pair


def without_most(scan: np.ndarray) -> None:
    scan[9:] = np.nan


def without_any(scan: np.ndarray) -> None:
    scan[:] = np.inf


def with_odd_readings(scan: np.ndarray) -> None:
    scan[::7] = np.array([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-7, 40.0])[np.arange(len(scan[::7])) % 7]


def in_steps(scan: np.ndarray) -> None:
    scan[:] = np.round(scan / 0.1) * 0.1


CASES = {
    "exact": (RING, scans(RING, 0.0)), "a centimetre": (RING, scans(RING, 0.01)), "noisy": (RING, scans(RING, 0.05)),
    "very noisy": (RING, scans(RING, 0.3)), "front": (FRONT, scans(FRONT, 0.02)),
    "mounted": (MOUNTED, scans(MOUNTED, 0.02)), "many beams": (DENSE, scans(DENSE, 0.015)),
    "steps": (RING, damaged(in_steps)), "few": (RING, damaged(without_most)), "none": (RING, damaged(without_any)),
    "odd readings": (RING, damaged(with_odd_readings)),
    "float32": (RING, tuple(scan.astype(np.float32) for scan in scans(RING, 0.01))),
    "one of float32": (RING, (scans(RING, 0.01)[0].astype(np.float32), scans(RING, 0.01)[1])),
    "three beams": (gs.Scanner([-1.0, 0.0, 1.0], 9.0), (np.ones(3), np.ones(3))),
    "corridor": (RING, tuple(segments_scan(CORRIDOR, (x, 0.0, 0.0), RING) for x in (0.0, 0.1))),
}  # fmt: skip


def assert_same(found: gs.ScanMatch, expected: gs.ScanMatch) -> None:
    """Compare the bits of two matches; axes of a single match are rounded differently and have arbitrary signs."""
    for field in dataclasses.fields(gs.ScanMatch):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if field.name == "eigenvalues":
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
        elif field.name != "directions":
            np.testing.assert_array_equal(one, other, field.name)
    if np.count_nonzero(expected.eigenvalues) > 1:
        np.testing.assert_allclose(np.abs(found.directions), np.abs(expected.directions), atol=1e-6)


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("guess", [(0.1, -0.05, 0.05), (-0.05, 0.05, 0.0), (0.5, 0.4, 0.4)])
@pytest.mark.parametrize(("precision", "noise"), [("float32", "auto"), ("float64", "auto"), ("float32", 0.03)])
def test_a_single_match_is_that_of_several(device, case, precision, noise, guess):
    scanner, (first, second) = CASES[case]
    options = {"backend": device, "precision": precision, "noise": noise}
    alone = gs.match_scan(first, second, scanner, guess, **options)
    # Two pairs, repeated by another launch.
    among = gs.match_scan(*(np.stack([scan, scan]) for scan in (first, second)), scanner, guess, **options)[1]
    assert_same(alone, among)


@pytest.mark.parametrize("backwards", [False, True])
def test_memory_of_a_turn_that_did_not_run_is_not_converted(device, backwards):
    """Numbers of former calls may be signalling NaN, whose conversion warns, and warnings are errors here."""
    scanner, pair = CASES["a centimetre"]
    if backwards:
        scanner, pair = gs.Scanner(scanner.bearings[::-1].copy(), scanner.range_max), tuple(one[::-1] for one in pair)
    options = {"backend": device, "precision": "float32"}
    gs.match_scan(*pair, scanner, (0.1, -0.05, 0.05), **options)
    lock, space = space_of(get_backend(device))
    with lock, space:
        space.upload("match result", np.full(2 * MATCH_RESULT, 0x7F800001, np.uint32).view(np.float32))
    assert np.isfinite(gs.match_scan(*pair, scanner, (0.1, -0.05, 0.05), **options).pose).all()


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("scanner", [RING, MOUNTED, DENSE], ids=["ring", "mounted", "dense"])
def test_devices_place_the_points_of_numpy(device, scanner, precision):
    real, backend = np.dtype(precision), get_backend(device)
    pair = np.array(scans(scanner, 0.02, seed=4))
    pair[1, ::5] = np.nan
    scene = _Scene(scanner, real, pair.dtype, 1.0, None, 2)
    space = Workspace(backend)
    space.upload("pair readings", pair)
    placed = _program(backend, space, scene, check_options(0.02, 1.0, (1.2, 1.05)))[0]
    with space:
        backend.run((placed,))
    arguments, points = placed.named(), scan_points(pair, scanner, real)

    def numbers(name: str, count: int, dtype: np.dtype) -> np.ndarray:
        return backend.download(arguments[name], np.empty(count, dtype))

    np.testing.assert_array_equal(numbers("point", points.point.size, real), points.point.ravel())
    np.testing.assert_array_equal(numbers("start", 3, np.dtype(np.int32)), points.start)
    level, first, second, *squares = numbers("summary", 5, np.dtype(float)).tolist()
    assert [first, second] == points.counts.tolist()
    assert squares == points.squares.tolist()
    noise = scan_noise(pair, scanner)
    assert noise_levels().noise[int(level)] == match_noise(noise[:1], noise[1:])[0]


def test_levels_of_noise_are_those_to_which_the_noise_of_matches_is_rounded():
    levels = noise_levels()
    largest = np.array(levels.largest)
    close = np.concatenate([np.nextafter(largest, 0), largest, np.nextafter(largest, 1)])
    noise = np.concatenate([close, np.geomspace(1e-4, 1.0, 2000)])
    expected = [match_noise(np.array([one]), np.array([one]))[0] for one in noise]
    level = np.minimum(np.searchsorted(largest, noise), len(largest) - 1)
    np.testing.assert_array_equal(np.array(levels.noise)[level], expected)
    assert match_noise(np.array([np.nan]), np.array([np.nan]))[0] == levels.noise[levels.assumed]


def test_scanners_and_options_in_turns_keep_their_programs(device):
    """Alternating matches of a workspace have the results of first calls, although their programs share buffers."""
    first, second, _ = random_pairs(1, RING, seed=2)
    wide = gs.match_scan(first[0], second[0], RING, backend=device)
    front = gs.match_scan(*scans(DENSE, 0.015), DENSE, backend=device)
    near = gs.match_scan(first[0], second[0], RING, backend=device, capture=0.5)
    assert not np.array_equal(wide.pose, near.pose)
    for _ in range(2):
        assert np.array_equal(gs.match_scan(first[0], second[0], RING, backend=device).pose, wide.pose)
        assert np.array_equal(gs.match_scan(*scans(DENSE, 0.015), DENSE, backend=device).pose, front.pose)
        assert np.array_equal(gs.match_scan(first[0], second[0], RING, backend=device, capture=0.5).pose, near.pose)


def test_icp_alone_and_moving_scans_are_those_of_several(device):
    first, second = scans(RING, 0.01)
    both = np.stack([first, first]), np.stack([second, second])
    for options in ({"method": "icp"}, {"motion": (0.05, 0.0, 0.02)}):
        alone = gs.match_scan(first, second, RING, (-0.05, 0.05, 0.0), backend=device, **options)
        among = gs.match_scan(*both, RING, (-0.05, 0.05, 0.0), backend=device, **options)[1]
        assert_same(alone, among)


@pytest.mark.parametrize("guess", [(0.1, -0.05, 0.05), (-0.05, 0.05, 0.0)], ids=["near", "poor"])
def test_a_match_without_a_search_takes_a_single_wait(device, monkeypatch, guess):
    """The kernel repeats a match with a poor guess, without another launch."""
    first, second = scans(RING, 0.005)
    reads = []
    read = Workspace.read
    monkeypatch.setattr(Workspace, "read", lambda self, *arguments: (reads.append(1), read(self, *arguments)))
    found = gs.match_scan(first, second, RING, guess, backend=device, precision="float64")
    assert found.converged
    assert len(reads) == 1
    assert (np.abs(found.pose - guess)[:2] > 0.1).any() == (guess[1] > 0)


@pytest.mark.parametrize("scans_of_call", [1, 2, 3, 64])
def test_squared_ranges_are_added_in_the_order_of_beams(scans_of_call):
    """NumPy adds rows pairwise or in lanes; kernels add sequentially."""
    z = np.random.default_rng(scans_of_call).uniform(0.1, 29.0, (scans_of_call, RING.count))
    expected = np.zeros(scans_of_call)
    for beam in np.argsort(np.mod(RING.bearings, 2 * np.pi), kind="stable"):
        expected += z[:, beam] * z[:, beam]
    assert scan_points(z, RING, np.dtype(np.float64)).squares.tolist() == expected.tolist()
