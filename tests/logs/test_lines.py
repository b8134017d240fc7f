"""Text files read line by line: compressed files that expand too far are refused."""

from __future__ import annotations

import gzip
import tracemalloc
import zlib

import pytest

import gpusense as gs
from gpusense._util import lines
from gpusense.evaluation.range_data import data_of_pairs


def bomb(file, piece, count):
    """Write ``count`` times ``piece`` as a gzip file, without the text in memory."""
    packer = zlib.compressobj(9, wbits=31)
    with file.open("wb") as stream:
        for _ in range(count):
            stream.write(packer.compress(piece))
        stream.write(packer.flush())
    return file


@pytest.mark.long
@pytest.mark.parametrize(
    ("piece", "count", "rule"),
    [(b"\n" * (1 << 20), 8, "lines in its compressed size"), (b"# " + b"x" * 65533 + b"\n", 6000, "bytes in its")],
    ids=["empty-lines", "comments"],
)
def test_a_small_file_of_much_text_is_refused(tmp_path, piece, count, rule):
    file = bomb(tmp_path / "run.log.gz", piece, count)
    assert file.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match=rule):
        list(gs.read_log(file))


def test_every_reader_of_lines_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(lines, "most_bytes", lambda size: 100_000)
    cases = {
        "pairs.csv.gz": (b"1.0,1.0\n" * 1000, lambda file: data_of_pairs(file, 5.0)),
        "hall.dat.gz": (b"1 0 -1 1\n" * 1000, gs.read_map),
        "run.log.gz": (b"ODOM 0 0 0 0 0 0 1 host 1\n" * 1000, lambda file: list(gs.read_log(file, range_max=5.0))),
    }
    for name, (piece, read) in cases.items():
        with pytest.raises(ValueError, match="must hold at most 100000 bytes"):
            read(bomb(tmp_path / name, piece, 100))


def test_logs_that_compress_well_are_read(tmp_path):
    line = b"ODOM 0 0 0 0 0 0 1 host 1\n"
    file = tmp_path / "run.log.gz"
    file.write_bytes(gzip.compress(line * 200_000))
    assert 200 * file.stat().st_size < 26 * 200_000
    assert sum(1 for _ in lines.numbered_lines(file)) == 200_000


def test_a_map_line_with_one_long_field_takes_no_more_memory_than_the_line(tmp_path):
    (tmp_path / "hall.dat").write_bytes(b"1 " * 1_000_000 + b"0" * 1_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="must have fields of at most 64 bytes"):
            gs.read_map(tmp_path / "hall.dat")
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
