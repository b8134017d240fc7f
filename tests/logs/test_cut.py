"""Logs that are cut off are read up to the cut, with a warning; broken ones and too long lines are errors."""

from __future__ import annotations

import gzip
import re
import struct
import tracemalloc
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from support import landmark_log
from support.bags import Writer
from support.text_logs import LOGS, each_text_format

import gpusense as gs
from gpusense._util import lines
from gpusense.evaluation.range_data import data_of_pairs
from gpusense.evaluation.trajectory_files import read_tum
from gpusense.logs.mrclam import read_mrclam


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
        assert gs.read_map(tmp_path / "hall.dat").shape == (1_000_001, 1)
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()


TUM = [f"{i}.0 {i}.5 2 0 0 0 0 1" for i in range(6)]


def count(path: Path, **options) -> int:
    return len(list(gs.read_log(path, **options)))


@each_text_format
@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_log_is_read_up_to_a_cut_in_its_last_line(tmp_path, form, packed, share):
    name, lines = LOGS[form.module]
    path = tmp_path / (f"{name}.gz" if packed else name)
    text = "\n".join(lines[:-1]) + "\n" + lines[-1][: int(len(lines[-1]) * share)]
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    with pytest.warns(UserWarning, match=f"{re.escape(path.name)}:6: the file ends in the middle of this line"):
        assert count(path) == 5


@each_text_format
def test_a_last_line_without_an_end_is_whole_and_a_few_bad_lines_are_skipped(tmp_path, form):
    name, lines = LOGS[form.module]
    path = tmp_path / name
    path.write_text("\n".join(lines))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert count(path) == 6
    # With a line break, in the middle, at the start, and two before a cut line.
    bad, end = lines[1][:30], "file ends in the middle"
    for each, good, rules in (
        ([*lines, bad, ""], 6, ["lines: 1; the first is line 7: "]),
        ([*lines[:2], bad, *lines[2:]], 6, ["is line 3: "]),
        ([bad, *lines], 6, ["is line 1: "]), ([bad, *lines[:4], bad, bad], 4, [end, "lines: 2; the first is line 1: "]),
    ):  # fmt: skip
        path.write_text("\n".join(each))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert count(path) == good
        assert len(told) == len(rules) and all(rule in str(one.message) for rule, one in zip(rules, told, strict=True))
    # Most lines are bad.
    path.write_text("\n".join([lines[0], bad, bad, bad, ""]))
    with pytest.raises(ValueError, match=f"{re.escape(name)}:2: "):
        count(path)
    # The cut line alone.
    path.write_text(lines[0][:30])
    with pytest.raises(ValueError, match=re.escape(name)):
        count(path)


def test_a_compressed_log_is_read_up_to_its_cut(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "run.log.gz"
    text = "\n".join(
        f"FLASER 60 {' '.join(map(str, rng.uniform(0, 9, 60)))} 0 0 0 0 0 0 {i}.5 host {i}.5" for i in range(400)
    )
    data = gzip.compress(text.encode())
    whole = [scan.ranges for scan in _read(path, data)]
    with pytest.warns(UserWarning, match="the compressed file is cut off; it is read up to line"):
        found = [scan.ranges for scan in _read(path, data[: len(data) // 2])]
    assert 150 < len(found) < 250 and np.array_equal(found, whole[: len(found)])
    for broken in (data[:8], data[:500] + b"\0" * 200 + data[700:]):
        with pytest.raises(ValueError, match="must be a whole gzip file"):
            _read(path, broken)


def _read(path: Path, data: bytes) -> list[gs.Scan]:
    path.write_bytes(data)
    return [record for record in gs.read_log(path, range_max=10.0) if isinstance(record, gs.Scan)]


def test_trajectories_and_runs_of_landmarks_are_read_up_to_their_cut(tmp_path):
    path = tmp_path / "run.tum"
    path.write_text("\n".join(TUM)[:-5])
    with pytest.warns(UserWarning, match=r"run\.tum:6: the file ends in the middle"):
        times, _ = read_tum(path)
    assert times.tolist() == [0, 1, 2, 3, 4]
    path.write_text("\n".join([*TUM[:3], "3.0 1 2"]) + "\n")
    with pytest.raises(ValueError, match="line 4 must have eight numbers"):
        read_tum(path)

    folder = landmark_log.write_run(tmp_path)
    whole = read_mrclam(folder, 1)
    measured = folder / "Robot1_Measurement.dat"
    data = measured.read_bytes().rstrip()
    last = data.rsplit(b"\n", 1)[1]
    measured.write_bytes(data[: -len(last.split()[-1]) - 1])
    with pytest.warns(UserWarning, match=r"Robot1_Measurement\.dat:\d+: the file ends"):
        assert 0 <= len(whole.ids) - len(read_mrclam(folder, 1).ids) <= 1


# ---- bags


def bag(folder: Path, kind: str) -> tuple[Path, Path]:
    """Write a bag of 2000 scans; return it and its file of messages."""
    with Writer(folder, kind) as writer:
        for i in range(2000):
            writer.scan(0.1 * i + 1, np.linspace(1, 5, 200) + i / 1000, -1.0, 0.01)
    path = writer.path
    return path, path if path.is_file() else next(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.999])
def test_a_bag_is_read_up_to_its_cut(tmp_path, needs_ros, kind, share):
    path, file = bag(tmp_path, kind)
    whole = [(scan.time, scan.ranges.tobytes()) for scan in gs.read_log(path)]
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    for each in {path, file}:
        with pytest.warns(UserWarning, match="the bag is cut off; it is read up to there"):
            found = [(scan.time, scan.ranges.tobytes()) for scan in gs.read_log(each)]
        assert found == whole[: len(found)] and len(found) > 1900 * share - 100


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_bag_that_is_cut_before_its_first_message_is_an_error(tmp_path, needs_ros, kind):
    path, file = bag(tmp_path, kind)
    data = file.read_bytes()
    for broken in (data[:60], data[:20], b""):
        file.write_bytes(broken)
        with pytest.raises(ValueError, match=str(file.name if path == file else path.name)), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            count(path)


def test_lengths_of_headers_are_not_believed(tmp_path, needs_ros):
    """A record that claims 2^60 bytes takes the bytes of the file."""
    file = tmp_path / "run.mcap"
    header = struct.pack("<BQ", 1, 12) + struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    file.write_bytes(b"\x89MCAP0\r\n" + header + struct.pack("<BQ", 6, 1 << 60) + bytes(100))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"run\.mcap"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        count(file)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_compressed_chunks_are_read_up_to_their_cut(tmp_path, needs_ros, compression):
    from rosbags.rosbag1 import Writer as Writer1

    with Writer(tmp_path, "ros1") as writer:
        writer.writer.close()
        writer.path.unlink()
        writer.writer = Writer1(writer.path)
        writer.writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        writer.writer.open()
        rng = np.random.default_rng(0)
        for i in range(4000):
            writer.scan(0.1 * i + 1, rng.uniform(1, 5, 200), -1.0, 0.01)
    data, active = writer.path.read_bytes(), tmp_path / "run.bag.active"
    active.write_bytes(data[: len(data) // 2])
    with pytest.warns(UserWarning, match=r"run\.bag\.active: the bag is cut off; it is read up to there"):
        assert count(active, mount=(0, 0, 0)) > 500


@pytest.fixture
def needs_ros() -> None:
    pytest.importorskip("rosbags")
