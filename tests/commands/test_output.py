"""Output of commands: atomic files, JSON, tables and progress."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from gpusense._util import checks, files
from gpusense._util.progress import progress
from gpusense.commands import output


def test_write_whole_replaces_or_leaves_as_it_was(tmp_path):
    path = tmp_path / "report.csv"
    files.write_whole(path, lambda stream: stream.write(b"first"))
    assert path.read_bytes() == b"first"

    def fail(stream):
        stream.write(b"half")
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        files.write_whole(path, fail)
    assert path.read_bytes() == b"first"
    files.write_whole(path, lambda stream: stream.write(b"second"))
    assert path.read_bytes() == b"second"
    assert [file.name for file in tmp_path.iterdir()] == ["report.csv"]


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need a privilege on Windows")
def test_write_whole_follows_a_link(tmp_path):
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_bytes(b"old")
    link.symlink_to(target)
    files.write_whole(link, lambda stream: stream.write(b"new"))
    assert link.is_symlink() and target.read_bytes() == b"new"
    target.unlink()
    with pytest.raises(FileNotFoundError, match="must exist, got a link that leads to no file"):
        checks.existing_file(link)


def test_one_of_a_kind_is_singular():
    assert [output.counted(number, "scan") for number in (0, 1, 2)] == ["0 scans", "1 scan", "2 scans"]


def test_write_whole_refuses_what_is_no_regular_file(tmp_path):
    with pytest.raises(ValueError, match="must be a regular file"):
        files.write_whole(tmp_path, lambda stream: stream.write(b""))


def test_json_has_no_numbers_that_json_does_not_know(capsys):
    values = {"a": np.float32(np.inf), "b": [float("nan"), 1], "c": np.array([1.5, -np.inf]), "d": Path("x"), "e": None}
    output.document(values)
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1], "c": [1.5, None], "d": "x", "e": None}


def test_plain_table_is_aligned():
    lines = output.table_lines(["name", "s"], [["numpy", "1.25"], ["a", "10.50"]], right=["s"])
    assert lines == ["name       s", "-----  -----", "numpy   1.25", "a      10.50"]


def test_terminal_gets_a_table_and_a_progress_bar(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    output.table(["name", "s"], [["[bold]numpy", "1.25"]], right=["s"])
    with progress(2) as step:
        step("one")
        step("two")
    out, err = capsys.readouterr()
    assert "[bold]numpy" in out and "1.25" in out
    assert "one" not in out and err != ""
