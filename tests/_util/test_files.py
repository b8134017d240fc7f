"""Files are written atomically, and an interrupt at any line leaves no unfinished file."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.interrupts import executed_lines, interrupt
from support.paths import ROOT

from gpusense._util import files
from gpusense._util.files import check_writable, write_several, write_whole

OLD, NEW = b"old", b"new contents"


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def write(stream: object) -> None:
    stream.write(NEW[:3])
    stream.write(NEW[3:])


# Calls, with the contents of a.txt and b.txt after each; None for no file.
CALLS: dict[str, tuple[Callable[[Path], object], dict[str, bytes | None]]] = {
    "check a new file": (lambda folder: check_writable(folder / "b.txt"), {"a.txt": OLD, "b.txt": None}),
    "check an old file": (lambda folder: check_writable(folder / "a.txt"), {"a.txt": OLD, "b.txt": None}),
    "write a new file": (lambda folder: write_whole(folder / "b.txt", write), {"a.txt": OLD, "b.txt": NEW}),
    "write an old file": (lambda folder: write_whole(folder / "a.txt", write), {"a.txt": NEW, "b.txt": None}),
    "write both": (
        lambda folder: write_several({folder / "a.txt": write, folder / "b.txt": write}), {"a.txt": NEW, "b.txt": NEW}
    ),
}  # fmt: skip


def contents(folder: Path) -> dict[str, bytes | None]:
    assert names(folder) <= {"a.txt", "b.txt"}
    return {name: (folder / name).read_bytes() if (folder / name).exists() else None for name in ("a.txt", "b.txt")}


@pytest.mark.parametrize("call", CALLS)
def test_an_interrupt_at_any_line_leaves_all_or_nothing(tmp_path, call):
    run, after = CALLS[call]
    before = {"a.txt": OLD, "b.txt": None}

    def fresh() -> None:
        for path in tmp_path.iterdir():
            path.unlink()
        (tmp_path / "a.txt").write_bytes(OLD)

    fresh()
    lines = executed_lines(lambda: run(tmp_path))
    assert contents(tmp_path) == after and len(lines) > 8
    reached = 0
    for line in lines:
        fresh()
        reached += interrupt(lambda: run(tmp_path), line)
        # The files are complete, even after an interrupt at the last lines.
        assert contents(tmp_path) in (before, after), line
    assert reached == len(lines)
    assert not files._UNFINISHED


class RefusedError(Exception):
    """Error of a writing function."""


def refuse(stream: object) -> None:
    stream.write(b"a part")
    raise RefusedError


def test_an_error_of_the_contents_leaves_what_was(tmp_path):
    (tmp_path / "a.txt").write_bytes(OLD)
    with pytest.raises(RefusedError):
        write_whole(tmp_path / "a.txt", refuse)
    with pytest.raises(RefusedError):
        write_several({tmp_path / "a.txt": write, tmp_path / "b.txt": refuse})
    assert contents(tmp_path) == {"a.txt": OLD, "b.txt": None}


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError) as error:
        write_whole(tmp_path / "none" / "a.txt", write)
    assert error.value.filename == str(tmp_path / "none")


def test_files_that_several_interrupts_have_left_go_at_the_end_of_the_process(tmp_path):
    code = (
        "import sys; from pathlib import Path; from gpusense._util import files\n"
        "files._discard = lambda fresh: (_ for _ in ()).throw(KeyboardInterrupt)\n"
        "original = files.Path.unlink\n"
        "try: files.check_writable(Path(sys.argv[1], 'a.txt'))\n"
        "except KeyboardInterrupt: print(len(list(Path(sys.argv[1]).iterdir())))\n"
        "files._discard = lambda fresh: original(fresh)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})  # fmt: skip
    assert done.stdout == "1\n" and names(tmp_path) == set()
