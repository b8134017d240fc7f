"""Look-up tables: their contents and their files."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from support.caster_world import RANGE, place, same_bits

import gpusense as gs
from gpusense.tables import casters
from gpusense.tables.casters import Lookup
from gpusense.tables.lookup_files import read_lookup, write_lookup


def saved(path: Path, backend: str = "numpy", bins: int = 12, **options: object) -> np.ndarray:
    """Write a table of the small map; return its numbers, (rows, cols, bins)."""
    grid, _, _ = place()
    gs.RayCaster(grid, RANGE, method=Lookup(bins), backend=backend, **options).save_table(path)
    head, _, body = path.read_bytes().partition(b"\n")
    assert json.loads(head)["bins"] == bins
    return np.frombuffer(body, "<u2").reshape(*grid.shape, bins)


def test_a_look_up_table_holds_the_exact_ranges_of_centres(backend, tmp_path, monkeypatch):
    grid, bins = place()[0], 12
    table = saved(tmp_path / "table", backend)
    # The frame is the grid's, so that headings have the bits of the table's.
    level = gs.OccupancyGrid(grid.cells, 1.0)
    poses = np.column_stack([level.cell_centers(*np.indices(grid.shape).reshape(2, -1)), np.zeros(grid.cells.size)])
    limit = RANGE / grid.resolution
    exact = gs.RayCaster(level, limit, backend="numpy").cast(poses, 2 * np.pi * np.arange(bins) / bins)
    part = exact.astype(np.float64).reshape(table.shape) / limit * 65535
    assert (table[part == 65535] == 65535).all()
    assert np.abs(table - np.minimum(part, 65534))[part < 65535].max() <= 0.5 + 0.02
    # Three rows at a time, and a last row.
    monkeypatch.setattr(casters, "_TILE", {"cpu": 2100, "gpu": 2100})
    np.testing.assert_array_equal(saved(tmp_path / "tiles", backend), table)


def test_a_saved_table_is_the_same_caster_on_another_backend(backend, tmp_path):
    grid, poses, bearings = place()
    made = gs.RayCaster(grid, RANGE, method=Lookup(12), backend="numpy", outside="occupied")
    made.save_table(str(tmp_path / "table"))
    read = gs.RayCaster(grid, RANGE, method=Lookup(12, file=tmp_path / "table"), backend=backend, outside="occupied")
    same_bits(read.cast(poses, bearings), made.cast(poses, bearings))
    read.save_table(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "table").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again", "table"]


def test_bins_of_any_integer_type_are_saved(tmp_path):
    assert saved(tmp_path / "table", bins=np.int64(8)).shape[2] == 8


def test_a_table_of_something_else_is_refused(tmp_path):
    grid, poses, bearings = place()
    path, other = tmp_path / "table", gs.OccupancyGrid(np.roll(grid.cells, 1), 0.1, grid.origin)
    saved(path)

    def read(scene=grid, range_max=RANGE, bins=12, **options):
        method = Lookup(bins, file=path)
        gs.RayCaster(scene, range_max, method=method, backend="numpy", **options).cast(poses[:3], bearings)

    read()
    for same, change in (
        ("obstacles", dict(scene=other)),
        ("obstacles", dict(unknown="occupied")),
        ("rows", dict(scene=gs.OccupancyGrid(grid.cells[1:], 0.1))),
        ("limit", dict(range_max=2.5)),
        ("outside", dict(outside="occupied")),
        ("bins", dict(bins=13)),
    ):
        with pytest.raises(ValueError, match=f"^file: must be a table of the same {same}, .*, got .* in .*table$"):
            read(**change)
    whole = path.read_bytes()
    head, _, body = whole.partition(b"\n")
    for damage, words in (
        (whole[:-1], "hold 53760 bytes of ranges, got 53759"),
        (whole + b"\0", "hold 53760 bytes of ranges, got 53761"),
        (head.replace(b'"rows": 40', b'"rows": 4000000000000') + b"\n" + body, "same rows, 40, got 4000000000000"),
        (head.replace(b"lookup 2", b"lookup 3") + b"\n" + body, "a look-up table that gpusense wrote"),
        (head.replace(b"lookup 2", b"lookup 1") + b"\n" + body, "a look-up table that gpusense wrote"),
        (b"", "a look-up table that gpusense wrote"),
        (bytes(range(256)) * 300, "a look-up table that gpusense wrote"),
        (b"7\n" + body, "a look-up table that gpusense wrote"),
    ):
        path.write_bytes(damage)
        with pytest.raises(ValueError, match=f"^file: must .*{words}.*table"):
            read()
    path.unlink()
    with pytest.raises(FileNotFoundError, match="table"):
        read()


@pytest.mark.parametrize("place_of", [0, 26_879 * 2, 26_880 * 2 - 1])
def test_a_changed_bit_of_a_range_is_refused(place_of, tmp_path):
    grid, path = place()[0], tmp_path / "table"
    saved(path)
    inputs = grid.obstacles(), RANGE / grid.resolution, "free", 12
    read_lookup(path, *inputs)
    head, _, body = path.read_bytes().partition(b"\n")
    damaged = bytearray(body)
    damaged[place_of] ^= 1
    path.write_bytes(head + b"\n" + damaged)
    with pytest.raises(
        ValueError, match=r"^file: must hold ranges of the SHA-256 in its header, '\w{64}', got \w{64} in"
    ):
        read_lookup(path, *inputs)
    path.write_bytes(head.replace(b"sha256", b"sha512") + b"\n" + body)
    with pytest.raises(ValueError, match=r"^file: must hold ranges of the SHA-256 in its header, None, got"):
        read_lookup(path, *inputs)


@pytest.mark.parametrize(
    "head",
    [b"[" * 4000, b'{"format": "gpusense lookup 2", "rows": 1e9, "cols": 1000000000, "bins": 12}', b"{" * 70_000],
    ids=["nested", "huge", "long"],
)
def test_a_file_that_claims_much_costs_nothing(head, tmp_path):
    grid = place()[0]
    path = tmp_path / "table"
    path.write_bytes(head + b"\n" + bytes(24))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"^file: must be a .*table"):
            read_lookup(path, grid.obstacles(), 30.0, "free", 12)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


def test_a_table_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "table"
    path.write_bytes(b"before")
    with pytest.raises(TypeError):
        write_lookup(path, np.zeros(3, np.uint16), {"no JSON": object()})

    def full(*_):
        raise OSError("the disk is full")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="the disk is full"):
        patch.setattr("gpusense._util.files.os.replace", full)
        saved(path)
    assert path.read_bytes() == b"before" and [one.name for one in tmp_path.iterdir()] == ["table"]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        saved(tmp_path / "nowhere" / "table")
