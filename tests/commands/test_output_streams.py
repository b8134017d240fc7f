"""Files of commands are written whole, tables are aligned, and streams that cannot be written are named."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import error_of

from gpusense._util import checks, files
from gpusense._util.files import write_several, write_whole
from gpusense._util.progress import progress
from gpusense.commands import cli, output
from gpusense.sweeps.tasks import jobs_of


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


def test_plain_table_is_aligned(capsys):
    output.table(["name", "s"], [["numpy", "1.25"], ["a", "10.50"]], right=["s"])
    assert capsys.readouterr().out.splitlines() == ["name       s", "-----  -----", "numpy   1.25", "a      10.50"]


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


def run(arguments: str, streams: str, folder: Path) -> subprocess.CompletedProcess[str]:
    line = f"{sys.executable} -m gpusense {arguments} {streams}"
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, cwd=folder, timeout=300, check=False)


@pytest.mark.parametrize("arguments, code", [("devices --nothing", 2), ("score --map a.yaml --log a.log", 2)])
def test_a_closed_standard_output_is_no_traceback(tmp_path: Path, arguments: str, code: int) -> None:
    done = run(arguments, ">&-", tmp_path)
    assert done.returncode == code and done.stderr.count("\n") == 1 and done.stderr.startswith("gpusense: error: ")
    assert run(arguments, ">&- 2>&-", tmp_path).returncode == code


def full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    for write in (write_whole, lambda path, one: write_several({path: one})):
        with pytest.raises(OSError, match=r"No space left on device: .*out\.bin") as error:
            write(tmp_path / "out.bin", full)
        assert error.value.filename == str(tmp_path / "out.bin")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_a_full_disk_while_a_bag_is_written(tmp_path, monkeypatch, capsys, kind) -> None:
    rosbags = pytest.importorskip("rosbags")
    assert rosbags
    import sqlite3

    from gpusense.logs import bag_writer

    def fail(*_: Any) -> None:
        if kind == "ros1":
            full()
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(bag_writer, "_write", fail)
    path = tmp_path / ("run.bag" if kind == "ros1" else "run")
    text = error_of(["simulate", "--world", "office", "--log-out", str(path), "--format", kind, "--scans", "2"], capsys)
    assert str(path) in text and " full" in text.replace("No space left on device", "is full")
    assert list(tmp_path.iterdir()) == []


def test_a_refused_fit_leaves_no_folder(tmp_path, capsys) -> None:
    (tmp_path / "pairs.csv").write_text("nothing\n")
    out = tmp_path / "some" / "folder"
    error_of(["fit", "--pairs", str(tmp_path / "pairs.csv"), "--range-max", "8", "--out", str(out)], capsys)
    assert not out.parent.exists()
    file = tmp_path / "pairs.csv"
    text = error_of(["fit", "--pairs", str(file), "--range-max", "8", "--out", str(file / "folder")], capsys)
    assert "--out: must be a folder that can be written to" in text


@pytest.mark.parametrize("step", ["1e9", "1e300", "101"])
def test_a_step_beyond_any_building_is_refused(tmp_path, capsys, step) -> None:
    arguments = ["simulate", "--world", "office", "--log-out", str(tmp_path / "run.log"), "--step", step]
    assert "step: must be finite and > 0 and <= 100" in error_of(arguments, capsys)


@pytest.mark.parametrize("value", ["1e9", "1e300", "10001", "0", "nan"])
def test_a_range_beyond_any_scanner_is_one_line(tmp_path, capsys, value) -> None:
    for arguments in (
        ["score", "--map", "m.yaml", "--log", "r.log"],
        ["simulate", "--world", "office", "--log-out", "r"],
    ):
        assert cli.main([*arguments, "--range-max", value]) == 2
        text = capsys.readouterr().err
        assert text.count("\n") == 1 and "argument --range-max: must be a number > 0 and <= 10000" in text


@pytest.mark.parametrize("options", [{"limit": -1}, {"limit": 0}, {"every": 0}, {"offset": -1}, {"training.every": 0},
                                     {"limit": 2.5}, {"every": True}])  # fmt: skip
def test_scans_of_a_sweep_are_checked_with_the_plan(options) -> None:
    plan = {"task": "localize", "options": {"map": "m.yaml", "log": "r.log", **options}}
    (name,) = options
    with pytest.raises((ValueError, TypeError), match=rf"options\.{name}: must be "):
        jobs_of(plan)
