"""The exact caster's kernels against walks in rational arithmetic; no pair of walls leaks."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from support.ray_oracles import backward_error_is_small, walk
from support.raycast_scenes import (
    FAMILIES,
    FLOAT32_CELLS,
    FLOAT32_MOVE,
    FLOAT32_TURN,
    FLOAT64_MOVE,
    FLOAT64_RELATIVE,
    FLOAT64_TURN,
    LAST_FLOAT32,
    PRECISIONS,
    Scene,
    as_float32,
    cast,
    scenes_of,
    unit,
)

from gpusense.evaluation.tolerances import differing
from gpusense.tables.rectangles import Planes


@pytest.mark.parametrize("precision", PRECISIONS)
def test_long_corridors(backend, precision):
    """Rays of 20 000 cells, parallel to an axis or oblique, end at the far wall through any cells."""
    length = 20_000
    occupied = np.zeros((9, length), bool)
    occupied[:, -1] = True
    occupied[0, 9::10] = occupied[-1, 4::10] = True
    rng = np.random.default_rng(1)
    frac = rng.integers(0, 1 << 24, (200, 2)) / (1 << 24)
    slope = as_float32(np.where(np.arange(200) % 2, rng.uniform(-1e-4, 1e-4, 200), 0.0))
    cell = np.stack([rng.integers(0, 50, 200), np.full(200, 4)], axis=1)
    scene = Scene(occupied, cell, frac, np.stack([np.ones(200), slope], axis=1), 30_000.0)
    expected = length - 1 - cell[:, 0] - frac[:, 0]
    error = np.abs(cast(scene, backend, precision) - expected)
    assert (error <= (FLOAT32_CELLS if precision == "float32" else FLOAT64_RELATIVE * expected)).all()


# The largest number of cells in a range.
MOST = 1 << 20


@pytest.mark.long
@pytest.mark.parametrize("precision", PRECISIONS)
def test_origins_nearly_as_far_off_as_a_range_may_be_long(precision, backend):
    """float64 ranges equal a rational walk's; float32 has the bits of NumPy's walk from cell to cell."""
    rng = np.random.default_rng(19)
    occupied = rng.random((50, 60)) < 0.02
    target = rng.uniform((0, 0), (60, 50), (600, 2))
    turn = np.where(np.arange(600) % 3, rng.uniform(-np.pi, np.pi, 600), rng.integers(0, 8, 600) * (np.pi / 4))
    direction = unit(turn)
    away = np.floor(rng.uniform(0.9, 0.9999, 600) * MOST)
    origin = target - direction * away[:, None]
    cell = np.floor(origin).astype(int)
    scene = Scene(occupied, cell, as_float32(np.minimum(origin - cell, LAST_FLOAT32)), direction, float(MOST))
    found = cast(scene, backend, precision)
    assert 100 < np.count_nonzero(found < MOST) < 600
    for sectors in (2, 4):
        assert differing(cast(scene, backend, precision, Planes(sectors)), found) == 0
    assert differing(found, cast(scene, "numpy", precision)) == 0
    if precision == "float64" and backend == "numpy":
        # The walk begins near the map, at an exact point of the ray.
        for i in range(0, 600, 4):
            ray, skipped = scene.ray(i), int(away[i]) - 100
            near = ray.moved(*(skipped * Fraction(d) for d in ray.direction), 0)
            near = dataclasses.replace(near, limit=MOST - skipped)
            assert abs(skipped + walk(occupied.tolist(), near).t - found[i]) <= 1e-9 or backward_error_is_small(
                occupied.tolist(), near, found[i] - skipped, move=1e-9, turn=FLOAT64_TURN, tolerance=1e-9
            )


@pytest.mark.parametrize("family", FAMILIES)
def test_float64_is_the_rational_walk(family, backend):
    for scene in scenes_of(family):
        found = cast(scene, backend, "float64")
        wrong = np.flatnonzero(np.abs(found - scene.exact) > FLOAT64_RELATIVE * scene.exact)
        if scene.grazes:
            wrong = unexplained(scene, found, wrong, FLOAT64_MOVE, FLOAT64_TURN, FLOAT64_RELATIVE)
        assert not len(wrong), [(scene.ray(i), scene.outside_occupied, found[i], scene.exact[i]) for i in wrong[:3]]


@pytest.mark.parametrize("family", FAMILIES)
def test_float32_is_the_rational_walk_of_a_ray_near_by(family):
    for scene in scenes_of(family):
        found = cast(scene, "numpy", "float32").astype(np.float64)
        wrong = np.flatnonzero(np.abs(found - scene.exact) > FLOAT32_CELLS)
        wrong = unexplained(scene, found, wrong, FLOAT32_MOVE, FLOAT32_TURN, FLOAT32_CELLS)
        assert not len(wrong), [(scene.ray(i), scene.outside_occupied, found[i], scene.exact[i]) for i in wrong[:3]]


def unexplained(
    scene: Scene, found: np.ndarray, suspects: np.ndarray, move: float, turn: float, tolerance: float
) -> list[int]:
    """Return the rays that also differ from all nearby rays."""
    cells = scene.occupied.tolist()
    return [
        i
        for i in suspects
        if not backward_error_is_small(
            cells, scene.ray(i), float(found[i]), move=move, turn=turn, tolerance=tolerance,
            outside_occupied=scene.outside_occupied,
        )
    ]  # fmt: skip


@pytest.mark.parametrize("precision", PRECISIONS)
def test_no_pair_of_walls_leaks_at_any_slope(precision, backend):
    """Rays aim at the common corner of two walls as exactly as floats allow; a wall stops them for any rounding."""
    rng = np.random.default_rng(13)
    for number in range(40):
        sign = rng.choice([-1, 1], 2)
        occupied = np.zeros((41, 41), bool)
        # The corner is (20, 20). Along the ray, the cells before and behind it are free; the lateral two are walls.
        occupied[20 if sign[1] < 0 else 19, 20 if sign[0] > 0 else 19] = True
        occupied[20 if sign[1] > 0 else 19, 20 if sign[0] < 0 else 19] = True
        if number % 2:
            away = rng.integers(1, 20, (100, 2)).astype(float)
            direction = away / 2.0 ** rng.integers(5, 8, (100, 1))
        else:
            away = rng.integers(1, 20 << 16, (100, 2)) / (1 << 16)
            direction = as_float32(away / np.hypot(*away.T)[:, None])
        origin = 20 - sign * away
        cell = np.floor(origin).astype(int)
        scene = Scene(occupied, cell, origin - cell, direction * sign, 2000.0)
        corner = np.hypot(*away.T) / np.hypot(*direction.T)
        found = cast(scene, backend, precision)
        assert (found <= corner * (1 + 1e-5)).all(), scene.ray(int(np.argmax(found - corner)))
