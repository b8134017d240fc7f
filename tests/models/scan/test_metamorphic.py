"""Laws that range models satisfy: there is no oracle, only two scenes whose results must agree.

Most laws are exact to the bit, because both scenes are equal in the grid's frame: poses are at odd multiples of 1/256
cell, resolutions are powers of two, and free cells around the walls extend beyond the largest distance that counts.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gpusense as gs
from gpusense.evaluation.tolerances import TOLERANCES, per_beam
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.reference.heading import cos_sin

CELL, MARGIN, RANGE, CAP, MOUNT = 0.25, 6, 6.0, 1.0, (0.2, -0.1, 0.3)
FIELD = {
    "ordinary": gs.LikelihoodFieldParameters(0.7, 0.1, 0.2, 0.15, CAP),
    "log domain": gs.LikelihoodFieldParameters(1.0, 0.0, 0.0, 0.15, CAP),
    "huge sigma": gs.LikelihoodFieldParameters(0.7, 0.1, 0.2, 1e6 * RANGE, CAP),
    "one part": gs.LikelihoodFieldParameters(0.0, 0.5, 0.5, 0.15, CAP),
    "tiny sigma": gs.LikelihoodFieldParameters(0.7, 0.1, 0.2, 1e-8 * RANGE, CAP),
}
PARAMETERS: dict[str, dict[str, Any]] = {
    "beam": {
        "ordinary": gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.1, 0.3),
        "log domain": gs.BeamParameters(0.7, 0.2, 0.1, 0.0, 1e-8 * RANGE, 0.0),
        "huge sigma": gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 1e6 * RANGE, 1e-12),
        "one part": gs.BeamParameters(0.0, 1.0, 0.0, 0.0, 0.1, 0.3),
        "tiny sigma": gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 1e-8 * RANGE, 1e6 / RANGE),
    },
    "field": FIELD,
    "bilinear": {name: p.replace(interpolation="bilinear") for name, p in FIELD.items()},
}
# The sum over beams: BLOCK_TERMS - 1 plain additions in a block, the constant of the max readings, the compensated
# total, the final sum and the temperature; each takes at most half an eps of the sum of the magnitudes.
SUM_ROUNDINGS = BLOCK_TERMS + 3

SEEDS, NAMES = st.integers(0, 2**32 - 1), st.sampled_from(list(FIELD))
# A tiny sigma shows different roundings of an interpolated distance (docs/numerics.md).
SMOOTH = st.sampled_from(list(FIELD)[:-1])
LAWS = settings(
    max_examples=10, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(params=PARAMETERS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=["float32", "float64"])
def on(request: pytest.FixtureRequest, backend: str) -> dict[str, str]:
    return {"backend": backend, "precision": request.param}


@dataclass(frozen=True)
class Scene:
    """A map, its place, poses, a scanner and a scan."""

    cells: np.ndarray
    poses: np.ndarray
    bearings: np.ndarray
    z: np.ndarray
    resolution: float = CELL
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_max: float = RANGE

    def model(self, parameters: Any, **options: Any) -> Any:
        grid = gs.OccupancyGrid(self.cells, self.resolution, self.origin)
        scanner = gs.Scanner(self.bearings, self.range_max, 0.0, self.mount)
        make = gs.BeamModel if isinstance(parameters, gs.BeamParameters) else gs.LikelihoodFieldModel
        return make(grid, scanner, parameters, **options)

    def cast(self, **on: str) -> np.ndarray:
        """Return (N, K) expected ranges of the beam model."""
        return self.model(gs.BeamParameters(), **on).expected_ranges(self.poses)

    def score(self, parameters: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return (N,) log p and the beams' (N, K) parts."""
        return self.model(parameters, **options).log_likelihood(self.poses, self.z, per_beam=True)

    @property
    def hits(self) -> np.ndarray:
        return (self.z >= 0) & (self.z < self.range_max)


@functools.cache
def scene(kind: str, seed: int, **changes: Any) -> Scene:
    """Return poses in the map, in walls and off it; half of the readings are those that the first pose expects.

    For a likelihood field they end in the wall and not on its face, an edge of two cells.
    """
    rng = np.random.default_rng(seed)
    walls = rng.random(rng.integers(4, 16, 2)) < rng.choice([0.03, 0.15])
    cells = np.pad(np.where(walls, 100, 0), MARGIN)
    place = [rng.integers(-2, n + 2, 12) + (2 * rng.integers(0, 128, 12) + 1) / 256 for n in cells.shape[::-1]]
    poses = np.column_stack([*(CELL * np.array(place)), rng.uniform(-4, 4, 12)])
    made = Scene(cells, poses, rng.uniform(-np.pi, np.pi, 24), rng.uniform(0, RANGE, 24), **changes)
    expected = made.cast(backend="numpy", precision="float64")[0]
    made.z[::2] = expected[::2] + (0.03 if kind != "beam" else 0)
    made.z[1:10:2] = [math.nan, math.inf, 0.0, np.nextafter(RANGE, 0), -1.0]
    return made


def same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.dtype == expected.dtype and found.shape == expected.shape
    np.testing.assert_array_equal(*(a.view(a.dtype.str.replace("f", "u")) for a in (found, expected)))


def same_scores(found: Scene, expected: Scene, parameters: Any, on: dict[str, str]) -> None:
    """Check log p and its parts, and the expected ranges of a beam model, to the bit."""
    for results in zip(*(each.score(parameters, **on) for each in (found, expected)), strict=True):
        same_bits(*results)
    if isinstance(parameters, gs.BeamParameters):
        same_bits(found.cast(**on), expected.cast(**on))


def assert_near(found: np.ndarray, expected: np.ndarray, allowed: Any) -> None:
    """Check that values are within the allowed difference; infinite ones must be equal."""
    with np.errstate(invalid="ignore"):
        apart = np.where(found == expected, 0, np.abs(found.astype(np.float64) - expected))
    assert (apart <= allowed).all(), float(np.max(apart - allowed))


def near_ranges(found: np.ndarray, expected: np.ndarray, float64: float) -> None:
    """Check ranges of rays that were rounded differently: float32 keeps its tolerance against float64 on both sides."""
    float32 = 2 * CELL * TOLERANCES["float32 ranges to float64"].value
    assert_near(found, expected, float32 if expected.dtype == np.float32 else float64)


def sum_error(parts: np.ndarray) -> np.ndarray:
    magnitude = np.abs(np.where(np.isfinite(parts), parts, 0).astype(np.float64)).sum(axis=1)
    return SUM_ROUNDINGS * np.finfo(parts.dtype).eps / 2 * magnitude


def plain_sum(log_p: np.ndarray, parts: np.ndarray) -> None:
    """Check that log p is the sum over the beams up to rounding."""
    assert_near(log_p, np.array([math.fsum(row) for row in parts.astype(np.float64)]), sum_error(parts))


def turned_and_mirrored_scores(after: Scene, before: Scene, parameters: Any, on: dict[str, str]) -> None:
    """Check bits; distances interpolated from the other side must be within the tolerance of both sides."""
    if getattr(parameters, "interpolation", "nearest") == "nearest":
        same_scores(after, before, parameters, on)
    found, expected = after.score(parameters, **on)[1], before.score(parameters, **on)[1]
    assert_near(found, expected, 2 * per_beam(expected, expected.dtype))


@pytest.mark.sampled(0.2, without="warp:cpu")
@LAWS
@given(SEEDS, SMOOTH, st.sampled_from([-1, 1, 2]))
def test_turn(kind, on, seed, name, quarters):
    """Headings are those whose cosine and sine turn exactly; in float32 nearly all do."""
    made = scene(kind, seed)
    theta = np.random.default_rng(seed).uniform(-4, 4, 4000)
    turned = theta + quarters * (np.pi / 2)
    (cos, sin), (turned_cos, turned_sin) = cos_sin(theta), cos_sin(turned)
    vectors = cos + 1j * sin, (turned_cos + 1j * turned_sin) * (-1j) ** quarters
    exact = np.equal(*np.array(vectors).astype({"float32": "c8", "float64": "c16"}[on["precision"]]))
    cells, (x, y, _) = made.cells, made.poses.T
    before = replace(made, poses=np.column_stack([x, y, theta[exact][:12]]))
    for _ in range(quarters % 4):
        cells, x, y = np.rot90(cells, -1), CELL * cells.shape[0] - y, x
    after = replace(made, cells=cells, poses=np.column_stack([x, y, turned[exact][:12]]))
    turned_and_mirrored_scores(after, before, PARAMETERS[kind][name], on)


@pytest.mark.sampled(0.35, without="warp:cpu")
@LAWS
@given(SEEDS, SMOOTH)
def test_mirror(kind, on, seed, name):
    before = scene(kind, seed)
    mirrored = before.poses * [1, -1, -1] + [0, CELL * before.cells.shape[0], 0]
    after = replace(before, cells=before.cells[::-1], poses=mirrored, bearings=-before.bearings)
    turned_and_mirrored_scores(after, before, PARAMETERS[kind][name], on)


@pytest.mark.sampled(0.15, without="warp:cpu")
@LAWS
@given(SEEDS, NAMES, st.integers(-10, 10), st.floats(-7, 7), st.integers(0, 40))
def test_shift(kind, on, seed, name, far, yaw, cells):
    """Shift the world by up to a million metres with an origin of any yaw, and by whole cells in a wider map."""
    turned, plain, p = scene(kind, seed, origin=(0.0, 0.0, yaw), mount=MOUNT), scene(kind, seed), PARAMETERS[kind][name]
    x, y, side = 1e5 * far, -1e5 * far, CELL * cells
    wide = replace(plain, cells=np.pad(plain.cells, ((cells, 3), (cells, 5))))
    same_scores(replace(turned, origin=(x, y, yaw), poses=turned.poses + np.array([x, y, 0])), turned, p, on)
    same_scores(replace(wide, poses=plain.poses + np.array([side, side, 0])), plain, p, on)
    same_scores(replace(wide, origin=(-side, -side, 0.0)), plain, p, on)


@pytest.mark.sampled(0.2, without="warp:cpu")
@LAWS
@given(SEEDS, NAMES, st.sampled_from([-11, -1, 1, 11]))
def test_all_lengths_times_a_power_of_two(kind, on, seed, name, power):
    """Ranges scale to the bit; a hit's density is per metre and falls by the factor, a max reading's does not."""
    s, before, p = 2.0**power, scene(kind, seed, mount=MOUNT), PARAMETERS[kind][name]
    lengths = {"resolution": s * CELL, "range_max": s * RANGE, "mount": (s * MOUNT[0], s * MOUNT[1], MOUNT[2])}
    after = replace(before, poses=before.poses * [s, s, 1], z=s * before.z, **lengths)
    shapes = {"lambda_short": p.lambda_short / s} if kind == "beam" else {"max_distance": s * CAP}
    found = after.score(p.replace(sigma_hit=s * p.sigma_hit, **shapes), **on)[1]
    expected, hits = before.score(p, **on)[1], before.hits
    same_bits(found[:, ~hits], expected[:, ~hits])
    shifted = expected[:, hits].astype(np.float64) - power * math.log(2)
    allowed = per_beam(expected[:, hits], on["precision"]) + per_beam(shifted, on["precision"])
    assert_near(found[:, hits], shifted, allowed)
    if kind == "beam":
        same_bits(after.cast(**on), (s * before.cast(**on)).astype(on["precision"]))


def cut_in_four(coarse: Scene) -> Scene:
    return replace(coarse, cells=coarse.cells.repeat(2, 0).repeat(2, 1), resolution=CELL / 2)


@pytest.mark.sampled(0.5, without="warp:cpu")
@LAWS
@given(SEEDS, NAMES)
def test_cells_cut_in_four_change_no_range(on, seed, name):
    """Ranges have the same bits where places are exact; elsewhere both casts are within their tolerance."""
    coarse = scene("beam", seed)
    same_scores(cut_in_four(coarse), coarse, PARAMETERS["beam"][name], on)
    other = replace(coarse, poses=coarse.poses + np.random.default_rng(seed).uniform(-0.1, 0.1, (12, 3)))
    near_ranges(cut_in_four(other).cast(**on), other.cast(**on), 2 * TOLERANCES["float64 ranges"].value * RANGE)


@pytest.mark.sampled(0.2, without="warp:cpu")
@LAWS
@given(SEEDS, NAMES)
def test_permuting_beams_and_particles(kind, on, seed, name):
    """Particles and parts have the same bits, and sums differ only by rounding; four beams repeat a bearing."""
    before, p, rng = scene(kind, seed, mount=MOUNT), PARAMETERS[kind][name], np.random.default_rng(seed)
    before = replace(before, bearings=np.concatenate([before.bearings[:20], before.bearings[:4]]))
    beams, particles = rng.permutation(24), rng.permutation(12)
    moved = replace(before, poses=before.poses[particles])
    permuted = replace(moved, bearings=before.bearings[beams], z=before.z[beams])
    (log_p, parts), (same, each), (other, some) = (s.score(p, **on) for s in (before, moved, permuted))
    same_bits(same, log_p[particles])
    same_bits(each, parts[particles])
    same_bits(some, each[:, beams])
    plain_sum(log_p, parts)
    plain_sum(other, some)


@pytest.mark.sampled(0.2, without="warp:cpu")
@LAWS
@given(SEEDS, NAMES, st.integers(0, 24))
def test_splitting_a_scan(kind, on, seed, name, count):
    """Omitted beams do not matter, and log p of both halves add up; a half may have no beam."""
    whole, p = scene(kind, seed, mount=MOUNT), PARAMETERS[kind][name]
    log_p, parts = whole.score(p, **on)
    total = np.zeros(len(log_p))
    for some in (np.arange(24) < count, np.arange(24) >= count):
        half, each = replace(whole, z=np.where(some, whole.z, math.nan)).score(p, **on)
        alone, own = replace(whole, bearings=whole.bearings[some], z=whole.z[some]).score(p, **on)
        same_bits(alone, half)
        same_bits(own, each[:, some])
        same_bits(each, np.where(some, parts, parts.dtype.type(0)))
        plain_sum(half, each)
        total += half
    assert_near(total, log_p, 2 * sum_error(parts))


@pytest.mark.sampled(0.3, without="warp:cpu")
@pytest.mark.parametrize("name", FIELD)
def test_no_information_is_exactly_0(kind, on, name):
    made = scene(kind, 0)
    for z in (np.full(24, math.nan), np.full(24, -math.inf), np.full(24, -1.0), np.empty(0)):
        some = replace(made, z=z, bearings=made.bearings[: len(z)])
        log_p, parts = some.score(PARAMETERS[kind][name], **on, temperature=0.3)
        same_bits(log_p, np.zeros(12, on["precision"]))
        same_bits(parts, np.zeros((12, len(z)), on["precision"]))
