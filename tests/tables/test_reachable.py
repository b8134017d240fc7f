"""The reachable part of a map gives the bits of the whole map, and is reused while the cloud stays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.model_world import BEARINGS, KINDS, RANGE, make, parts_of_kind, room, same_bits, scan

import gpusense as gs
from gpusense.models.scan import packed_call
from gpusense.tables.reachable import ReachableMap
from gpusense.world import windows


@pytest.mark.sampled(0.3, without="warp:cpu")
@pytest.mark.parametrize("kind", [*KINDS, "caster"])
@pytest.mark.parametrize("outside", ["free", "occupied"])
def test_a_cropped_map_gives_the_same_bits(kind, outside, backend, monkeypatch):
    """Clouds stay, leave the window, touch the border, jump, and return."""
    grid = room((400, 500))
    z = scan()
    rng = np.random.default_rng(5)

    def around(row: int, col: int, spread: float) -> np.ndarray:
        center = grid.cell_centers([row], [col])
        return np.column_stack([center + rng.normal(0, spread, (40, 2)), rng.uniform(-4, 4, 40)])

    tour = [around(200, 250, 0.2), around(203, 252, 0.3), around(260, 250, 0.3), around(0, 0, 0.5), around(399, 10, 1),
            around(-30, 520, 0.3), around(200, 250, 0.2), around(200, 250, 15.0), around(200, 250, 0.2)]  # fmt: skip

    def results(**options: Any) -> tuple[list[np.ndarray], list[int]]:
        if kind == "caster":
            owner = gs.RayCaster(grid, RANGE, backend=backend, outside=outside)
            found = [owner.cast(poses, BEARINGS) for poses in tour]
        else:
            owner = make(kind, grid, backend, outside=outside, **options)
            found = [owner.log_likelihood(poses, z) for poses in tour]
        (table,) = parts_of_kind(owner, ReachableMap)
        return found, [table.preparations, table.window.cells]

    whole, (preparations, cells) = results()
    assert (preparations, cells) == (1, 400 * 500)
    monkeypatch.setattr(windows, "SMALLEST_CELLS", 1)
    # Short calls on GPUs use a table of the whole map.
    monkeypatch.setattr(packed_call, "MOST_CELLS", 0)
    cropped, (preparations, cells) = results()
    assert preparations >= 4
    for a, b in zip(whole, cropped, strict=True):
        same_bits(a, b)
    if kind == "beam":
        plain, (preparations, cells) = results(specialize=False)
        assert (preparations, cells) == (1, 400 * 500)
        for a, b in zip(plain, cropped, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-5)


def test_a_window_is_kept_while_the_cloud_stays(backend, monkeypatch):
    monkeypatch.setattr(windows, "SMALLEST_CELLS", 1)
    # Short calls on GPUs use a table of the whole map.
    monkeypatch.setattr(packed_call, "MOST_CELLS", 0)
    grid, z = room((400, 500)), scan()
    model = make("beam", grid, backend)
    center = grid.cell_centers([200], [250])
    rng = np.random.default_rng(0)
    for step in range(20):
        poses = np.column_stack([center + rng.normal(0, 0.1, (30, 2)) + 0.02 * step, rng.uniform(-4, 4, 30)])
        model.log_likelihood(poses, z)
        model.expected_ranges(poses)
    (table,) = parts_of_kind(model, ReachableMap)
    assert table.preparations == 1
    assert table.window.cells < 0.5 * 400 * 500
