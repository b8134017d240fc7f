"""A process's folder for the kernels of drivers: location, and removal of old folders."""

from __future__ import annotations

import errno
import mmap
import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.cache_folders import contents

from gpusense.backends import scratch
from gpusense.backends.scratch import scratch_folder


@pytest.fixture
def made(place):
    """Return a function that remakes this process's folder; remove all folders at the end."""
    found: list[Path] = []

    def make(*, executable: bool = True) -> Path:
        scratch._scratch.cache_clear()
        found.append(scratch_folder(executable=executable))
        return found[-1]

    before = scratch._scratch
    yield make
    assert scratch._scratch is before
    scratch._scratch.cache_clear()
    for path in found:
        shutil.rmtree(path, ignore_errors=True)


def test_a_process_has_a_folder_in_the_cache(place, made):
    path = made()
    assert path.parent == place / scratch.OWN and stat.S_IMODE(path.stat().st_mode) == 0o700
    assert [entry.name for entry in path.iterdir()] == ["lock"]


def test_a_folder_without_room_is_passed_over(place, made, temporary, monkeypatch):
    real, full = os.posix_fallocate, {str(place)}

    def fallocate(handle, begin, size):
        if any(os.readlink(f"/proc/self/fd/{handle}").startswith(name) for name in full):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle, begin, size)

    monkeypatch.setattr(os, "posix_fallocate", fallocate)
    assert made().is_relative_to(temporary)
    assert not list(place.rglob("gpusense-run-*"))
    full |= {str(temporary), "/dev/shm", "/var/tmp"}
    message = r"there is none among GPUSENSE_CACHE_DIR: .*No space left.*TMPDIR: .*: set GPUSENSE_CACHE_DIR or TMPDIR"
    with pytest.raises(OSError, match=message):
        made()


def no_code(monkeypatch, *places: str) -> None:
    """Refuse to map files below some folders as code, like a file system mounted without execution."""
    real = mmap.mmap

    def mapped(handle, *arguments, prot=mmap.PROT_READ, **options):
        if prot & mmap.PROT_EXEC and os.readlink(f"/proc/self/fd/{handle}").startswith(places):
            raise PermissionError(errno.EPERM, "Operation not permitted")
        return real(handle, *arguments, prot=prot, **options)

    monkeypatch.setattr(mmap, "mmap", mapped)


def test_where_no_code_may_run_only_drivers_that_read_files_have_a_folder(place, made, temporary, monkeypatch):
    no_code(monkeypatch, str(place))
    assert made().is_relative_to(temporary)
    # One folder serves both if possible.
    assert made(executable=False).is_relative_to(temporary)
    no_code(monkeypatch, "/")
    with pytest.raises(OSError, match=r"from which code may run, and there is none among .*no code may run from there"):
        made()
    assert made(executable=False).is_relative_to(place)


def test_a_folder_that_others_can_replace_is_passed_over(place, made, temporary, caplog):
    place.mkdir()
    place.chmod(0o777)
    assert made().is_relative_to(temporary)
    assert f"the cache folder {place} is not used: {place}, which holds" in caplog.messages[0]


_HOLD = """
import sys, time
from gpusense.backends.scratch import scratch_folder
print(scratch_folder(), flush=True)
sys.stdin.readline()
"""


def test_the_folder_goes_with_its_process_and_that_of_a_killed_one_later(made):
    holders = []
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", _HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert process.stdout is not None
        holders.append((process, Path(os.fsdecode(process.stdout.readline().strip()))))
    (ends, first), (killed, second), (lives, third) = holders
    ends.communicate(b"\n")
    assert not first.exists()
    killed.kill()
    killed.wait()
    assert second.exists()
    # The folder's process may not have locked it yet.
    made()
    assert second.exists()
    for path in (second, third):
        os.utime(path, (time.time() - 7200,) * 2)
    made()
    assert not second.exists() and third.exists()
    lives.communicate(b"\n")
    assert not third.exists()


def text(name: str) -> bytes:
    return scratch._lock_text(name)


# Name of a folder, contents of its lock file, other files, and whether a killed process of gpusense left it.
LEFT = {
    "whole": ("gpusense-run-abcdefgh", text("gpusense-run-abcdefgh"), ["warp/module.o"], True),
    "no lock file yet": ("gpusense-run-abcdefgh", None, [], True),
    "an empty lock file": ("gpusense-run-abcdefgh", b"", [], True),
    "half a lock file": ("gpusense-run-abcdefgh", text("gpusense-run-abcdefgh")[:9], [], True),
    "a user's": ("run-07", b"", ["result.csv"], False),
    "a user's with an old name": ("run-abcdefgh", b"", ["result.csv"], False),
    "a user's with this name": ("gpusense-run-abcdefgh", b"pid 7", ["result.csv"], False),
    "an empty lock beside files": ("gpusense-run-abcdefgh", b"", ["result.csv"], False),
    "no lock beside files": ("gpusense-run-abcdefgh", None, ["result.csv"], False),
    "another's lock": ("gpusense-run-abcdefgh", text("gpusense-run-abcdefgi"), ["result.csv"], False),
    "a longer name": ("gpusense-run-abcdefgh2", text("gpusense-run-abcdefgh2"), ["result.csv"], False),
}


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("case", LEFT)
def test_only_folders_that_processes_of_gpusense_left_are_removed(tmp_path, made, monkeypatch, case, shared):
    """Folders are in the cache, or in a folder for files of all users."""
    name, lock, others, removed = LEFT[case]
    parent = scratch.own_folder(tmp_path / "cache")
    if shared:
        parent = tmp_path / "shared"
        parent.mkdir()
        parent.chmod(0o1777)
        monkeypatch.setattr(scratch, "_candidates", lambda: [("shared", lambda: parent)])
    folder = parent / name
    folder.mkdir(mode=0o700)
    for other in others:
        (folder / other).parent.mkdir(exist_ok=True)
        (folder / other).write_text("contents")
    if lock is not None:
        (folder / "lock").write_bytes(lock)
    os.utime(folder, (time.time() - 1e6,) * 2)
    before = contents(folder)
    assert made().parent == parent
    assert folder.exists() is not removed
    assert removed or contents(folder) == before


@pytest.mark.parametrize("change", ["mode", "owner", "link", "fifo"])
def test_a_folder_that_is_not_private_is_not_removed(tmp_path, made, change):
    parent, name = scratch.own_folder(tmp_path / "cache"), "gpusense-run-abcdefgh"
    folder = parent / name
    folder.mkdir(mode=0o700)
    (folder / "lock").write_bytes(text(name))
    if change == "mode":
        folder.chmod(0o770)
    elif change == "owner":
        if os.geteuid() != 0:
            pytest.skip("only root can give folders away")
        os.chown(folder, 65534, -1)
    elif change == "link":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        (folder / "lock").unlink()
        os.mkfifo(folder / "lock")
    os.utime(folder, (time.time() - 1e6,) * 2)
    made()
    assert folder.exists() and os.path.lexists(folder / "lock")
