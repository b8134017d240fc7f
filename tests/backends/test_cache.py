"""The cache on disk, the folder of a process, and runs whose caches are damaged, locked, full or shared."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import fake_driver

from gpusense.backends import BackendInfo, cache, scratch
from gpusense.backends.cache import ProgramCache, load_entry, pack, store_entry, unpack, write_files


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Use a cache folder of this test alone."""
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path / "elsewhere"))
    monkeypatch.delenv("GPUSENSE_CACHE", raising=False)
    return tmp_path / "cache"


INFO = BackendInfo("opencl:0:0", "opencl", "Some device", "gpu", "Driver 1", 1 << 30, 1 << 28, True)


def test_a_program_is_kept_and_found_again(folder):
    programs = ProgramCache(INFO)
    assert programs.load("source", ["-a"]) is None
    programs.store("source", ["-a"], b"binary")
    assert programs.load("source", ["-a"]) == b"binary"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert [path.suffix for path in folder.iterdir()] == [".bin"]


@pytest.mark.parametrize("other", ["source", "options", "driver", "device", "processor"])
def test_entries_are_keyed_by_device_driver_options_and_source(folder, monkeypatch, other):
    base = dataclasses.replace(INFO, kind="cpu") if other == "processor" else INFO
    ProgramCache(base).store("source", ["-a"], b"binary")
    if other == "processor":
        monkeypatch.setattr(cache, "fingerprint", lambda: "another")
    info = {
        "driver": BackendInfo("opencl:0:0", "opencl", "Some device", "gpu", "Driver 2", 1, 1, True),
        "device": BackendInfo("opencl:0:0", "opencl", "Other device", "gpu", "Driver 1", 1, 1, True),
    }.get(other, base)
    source = "changed" if other == "source" else "source"
    assert ProgramCache(info).load(source, ["-b" if other == "options" else "-a"]) is None


@pytest.mark.parametrize("damage", [b"", b"short", b"gpusense entry 2\n" + bytes(32) + b"binary"])
def test_a_damaged_entry_is_dropped(folder, damage):
    programs = ProgramCache(INFO)
    programs.store("source", [], b"binary")
    (entry,) = folder.iterdir()
    entry.write_bytes(damage)
    assert programs.load("source", []) is None
    assert not entry.exists()


def test_the_cache_is_bounded_and_drops_the_oldest(folder, monkeypatch):
    monkeypatch.setattr(cache, "MAX_ENTRIES", 3)
    programs = ProgramCache(INFO)
    for number in range(5):
        programs.store(f"source {number}", [], b"binary")
        for entry in folder.iterdir():
            os.utime(entry, (entry.stat().st_atime, entry.stat().st_mtime - 10))
    assert [programs.load(f"source {number}", []) for number in range(5)] == [None, None, *[b"binary"] * 3]
    monkeypatch.setattr(cache, "MAX_BYTES", 100)
    programs.store("large", [], bytes(60))
    assert sum(entry.stat().st_size for entry in folder.iterdir()) <= 100 + 60


def test_the_cache_can_be_switched_off(folder, monkeypatch):
    monkeypatch.setenv("GPUSENSE_CACHE", "off")
    ProgramCache(INFO).store("source", [], b"binary")
    assert not folder.exists()
    assert ProgramCache(INFO).load("source", []) is None


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Use a folder of temporary files of this test alone, with no failure reported before."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(cache, "_reported", set())
    cache._takes_files.cache_clear()
    return tmp_path / "tmp"


def blocked(tmp_path: Path, how: str) -> Path:
    """Return a cache folder that no user can make or write."""
    if how == "a file in its place":
        (tmp_path / "file").write_text("not a folder")
        return tmp_path / "file"
    if how == "a file above it":
        (tmp_path / "file").write_text("not a folder")
        return tmp_path / "file" / "cache"
    # Not even root writes there.
    return Path("/proc/gpusense")


BLOCKED = ["a file in its place", "a file above it", "a read-only system"]


@pytest.mark.parametrize("how", BLOCKED)
def test_a_private_temporary_folder_takes_the_place_of_one_that_cannot_be_written(
    tmp_path, temporary, monkeypatch, caplog, how
):
    if how == "a read-only system" and not os.path.isdir("/proc/self"):
        pytest.skip("there is no /proc")
    place = blocked(tmp_path, how)
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(place))
    for number in range(3):
        store_entry(f"key {number}", b"payload")
    assert [load_entry(f"key {number}") for number in range(3)] == [b"payload"] * 3
    (folder,) = temporary.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and len(list(folder.iterdir())) == 3
    (message,) = caplog.messages
    assert message.startswith(f"gpusense: the cache folder {place} cannot be written: ")


@pytest.mark.parametrize("how", ["others may write", "a link"])
def test_a_temporary_folder_of_another_user_is_not_used(tmp_path, temporary, monkeypatch, how):
    name = temporary / f"gpusense-{os.getuid()}"
    if how == "a link":
        (tmp_path / "elsewhere").mkdir()
        name.symlink_to(tmp_path / "elsewhere")
    else:
        name.mkdir()
        name.chmod(0o777)
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(blocked(tmp_path, "a file in its place")))
    assert cache.temporary_folder() is None
    store_entry("key", b"payload")
    assert load_entry("key") is None


def test_without_a_home_the_cache_is_temporary(temporary, monkeypatch):
    for name in ("GPUSENSE_CACHE_DIR", "GPUSENSE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def no_home():
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", no_home)
    store_entry("key", b"payload")
    assert load_entry("key") == b"payload"
    assert len(list(temporary.rglob("*.bin"))) == 1


def test_unfinished_files_of_killed_processes_are_removed(folder):
    store_entry("first", b"payload")
    for name, age in (("old.tmp", 7200), ("new.tmp", 0)):
        (folder / name).write_bytes(b"half")
        os.utime(folder / name, (time.time() - age,) * 2)
    store_entry("second", b"payload")
    assert sorted(path.name for path in folder.glob("*.tmp")) == ["new.tmp"]


def test_files_are_packed_and_unpacked(tmp_path):
    files = {"a/b/program.bc": os.urandom(1000), "a/c.so": b"", "d": b"x" * 9}
    assert unpack(pack(files)) == files
    assert pack(files) == pack(dict(reversed(files.items())))
    write_files(tmp_path, files)
    assert {p.relative_to(tmp_path).as_posix(): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == files


@pytest.mark.parametrize("name", ["../out", "/etc/passwd", "a/../../out"])
def test_packed_files_stay_below_their_folder(name):
    with pytest.raises(ValueError, match="must hold paths below its folder"):
        unpack(pack({name: b""}))
    with pytest.raises(ValueError, match="must hold packed files"):
        unpack(b"something else")


# ---- the folder of a process


@pytest.fixture
def made(folder, monkeypatch):
    """Return a function that makes this process's folder anew; remove all of them in the end."""
    folders: list[Path] = []

    def make() -> Path:
        folders.append(scratch.scratch_folder.__wrapped__())
        return folders[-1]

    yield make
    for path in folders:
        shutil.rmtree(path, ignore_errors=True)


def test_a_process_has_a_folder_in_the_cache(folder, made):
    path = made()
    assert path.parent == folder and stat.S_IMODE(path.stat().st_mode) == 0o700
    assert [entry.name for entry in path.iterdir()] == ["lock"]


def test_a_folder_without_room_or_code_is_passed_over(folder, made, temporary, monkeypatch):
    real, full = os.posix_fallocate, {str(folder)}

    def fallocate(handle, begin, size):
        if any(os.readlink(f"/proc/self/fd/{handle}").startswith(name) for name in full):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle, begin, size)

    monkeypatch.setattr(os, "posix_fallocate", fallocate)
    assert made().is_relative_to(temporary)
    assert not list(folder.glob("run-*"))
    full |= {str(temporary), "/dev/shm", "/var/tmp"}
    with pytest.raises(OSError, match=r"there is none among .*No space left.*set GPUSENSE_CACHE_DIR or TMPDIR"):
        made()
    full.clear()
    status = os.statvfs(folder)

    class NoCode:
        f_flag = status.f_flag | os.ST_NOEXEC

    statvfs = os.statvfs
    monkeypatch.setattr(os, "statvfs", lambda path: NoCode if Path(path) == folder else statvfs(path))
    assert made().is_relative_to(temporary)


_HOLD = """
import sys, time
from gpusense.backends.scratch import scratch_folder
print(scratch_folder(), flush=True)
sys.stdin.readline()
"""


def test_the_folder_goes_with_its_process_and_that_of_a_killed_one_later(folder, made):
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
    # It may be a process that has not locked its folder yet.
    made()
    assert second.exists()
    for path in (second, third):
        os.utime(path, (time.time() - 7200,) * 2)
    made()
    assert not second.exists() and third.exists()
    lives.communicate(b"\n")
    assert not third.exists()


# ---- whole runs


_RUN = """
import sys
import numpy as np, gpusense as gs
cells = np.zeros((20, 20), int); cells[5] = 100
grid, scanner = gs.OccupancyGrid(cells, 1.0), gs.Scanner([0.0, 0.1], range_max=10.0)
poses, ranges = [[2.5, 1.5, 1.5707963267948966], [3.5, 2.5, 1.0]], [3.5, 3.4]
for kind in (gs.BeamModel, gs.LikelihoodFieldModel):
    print(np.round(kind(grid, scanner, backend=sys.argv[1]).log_likelihood(poses, ranges), 3).tolist(), flush=True)
"""


def start(family: str, environment: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _RUN, family], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )  # fmt: skip


def outcome(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, errors = process.communicate(timeout=300)
    return process.returncode, out, errors


@pytest.fixture(scope="module")
def expected() -> str:
    code, out, errors = outcome(start("numpy", dict(os.environ)))
    assert code == 0, errors
    return out


def entries(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_ino for path in folder.glob("*.bin")}


@pytest.mark.parametrize("family", ["opencl", "warp:cpu"])
def test_a_second_process_compiles_nothing(needs, tmp_path, expected, family):
    """A compiled kernel is stored as an entry; a second process stores none."""
    needs(family.split(":")[0])
    environment = fake_driver.environment(tmp_path)
    assert outcome(start(family, environment)) == (0, expected, "")
    first = entries(tmp_path / "cold")
    assert len(first) > 5
    assert outcome(start(family, environment)) == (0, expected, "")
    assert entries(tmp_path / "cold") == first
    assert [path.name for path in (tmp_path / "cold").iterdir() if path.suffix != ".bin"] == []


@pytest.mark.parametrize("family", ["opencl", "warp:cpu"])
def test_with_the_cache_off_nothing_is_kept(needs, tmp_path, expected, family):
    needs(family.split(":")[0])
    environment = fake_driver.environment(tmp_path, GPUSENSE_CACHE="off", GPUSENSE_PROOF="off", TMPDIR=str(tmp_path))
    assert outcome(start(family, environment)) == (0, expected, "")
    # The database is pyopencl's own, and is empty.
    assert [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".sqlite"] == []


DAMAGES = {
    "cut off": lambda data: data[: len(data) // 2],
    "emptied": lambda data: b"",
    "zeroed": lambda data: bytes(len(data)),
    "a bit flipped in the head": lambda data: bytes([data[0] ^ 1]) + data[1:],
    "a bit flipped in the contents": lambda data: data[:-9] + bytes([data[-9] ^ 16]) + data[-8:],
    "another's contents": lambda data: b"gpusense entry 2\n" + bytes(200),
}


@pytest.mark.slow
@pytest.mark.parametrize("family", ["opencl", "warp:cpu"])
def test_damaged_files_of_every_kind_are_made_anew(needs, tmp_path, expected, family):
    """Entries of verdicts, programs, and PoCL's and Warp's kernels, and folders in the place of entries."""
    needs(family.split(":")[0])
    environment = fake_driver.environment(tmp_path)
    assert outcome(start(family, environment)) == (0, expected, "")
    whole = entries(tmp_path / "cold")
    assert len(whole) >= len(DAMAGES)
    for number, name in enumerate(sorted(whole)):
        path = tmp_path / "cold" / name
        path.write_bytes(list(DAMAGES.values())[number % len(DAMAGES)](path.read_bytes()))
    assert outcome(start(family, environment)) == (0, expected, "")
    assert entries(tmp_path / "cold").keys() == whole.keys()
    for name in whole:
        (tmp_path / "cold" / name).unlink()
        (tmp_path / "cold" / name).mkdir()
    code, out, errors = outcome(start(family, environment))
    assert (code, out, errors.count("\n")) == (0, expected, 1), errors
    assert f"the cache folder {tmp_path / 'cold'} cannot be written" in errors


@pytest.mark.slow
@pytest.mark.parametrize(("family", "how"), [("opencl", BLOCKED[0]), ("opencl", BLOCKED[2]), ("warp:cpu", BLOCKED[1])])
def test_a_cache_that_cannot_be_written_is_named_and_stops_nothing(needs, tmp_path, expected, family, how):
    """gpusense's own folder, and where PoCL and Warp would put theirs."""
    needs(family.split(":")[0])
    place = str(blocked(tmp_path, how))
    (tmp_path / "tmp").mkdir()
    places = dict.fromkeys(("GPUSENSE_CACHE_DIR", "XDG_CACHE_HOME", "POCL_CACHE_DIR", "WARP_CACHE_PATH"), place)
    environment = fake_driver.environment(tmp_path, **places, TMPDIR=str(tmp_path / "tmp"))
    for turn in range(2):
        code, out, errors = outcome(start(family, environment))
        assert (code, out) == (0, expected), errors
        lines = [line for line in errors.splitlines() if line.startswith("gpusense: ")]
        assert len(lines) == len(errors.splitlines()) and all(place in line for line in lines)
        assert turn or lines
    assert len(list((tmp_path / "tmp").rglob("*.bin"))) > 5


@pytest.mark.slow
def test_a_full_file_system_is_named_and_stops_nothing(needs, tmp_path, expected):
    """A file system of 256 KiB as the cache; the folder of the process goes elsewhere."""
    needs("opencl")
    full = tmp_path / "full"
    full.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(full)], capture_output=True)
    if mounted.returncode:
        pytest.skip("this user cannot mount a small file system")
    try:
        (full / "filler").write_bytes(bytes(200 << 10))
        environment = fake_driver.environment(tmp_path, GPUSENSE_CACHE_DIR=str(full), XDG_CACHE_HOME=str(full))
        for turn in range(2):
            code, out, errors = outcome(start("opencl", environment))
            assert (code, out) == (0, expected), errors
            assert turn or f"the cache folder {full} cannot be written: No space left" in errors
    finally:
        subprocess.run(["umount", "-l", str(full)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["opencl", "warp:cpu"])
def test_killed_processes_leave_nothing_that_a_later_one_trips_over(needs, tmp_path, expected, family):
    """Processes of each family are killed with all they started, half of them while they prove the device."""
    needs(family.split(":")[0])
    moments = random.Random(family)
    ended = 0
    for number in range(12):
        proof = {} if number % 2 else {"GPUSENSE_PROOF": "off"}
        environment = fake_driver.environment(tmp_path, **proof)
        if number % 8 == 0:
            shutil.rmtree(tmp_path / "cold", ignore_errors=True)
        process = start(family, environment)
        time.sleep(moments.uniform(0.2, 1.6))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        code, out, errors = outcome(process)
        assert code in (0, -signal.SIGKILL), errors
        assert expected.startswith(out)
        ended += code == 0
    assert ended < 12
    assert outcome(start(family, fake_driver.environment(tmp_path))) == (0, expected, "")


@pytest.mark.slow
@settings(max_examples=2, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    families=st.tuples(*[st.sampled_from(["opencl", "warp:cpu"])] * 2),
    delay=st.floats(0, 2.5),
    kill=st.none() | st.floats(0.3, 2.5),
)
def test_two_processes_may_start_cold_at_once_in_any_order(needs, tmp_path_factory, expected, families, delay, kill):
    for family in families:
        needs(family.split(":")[0])
    environment = fake_driver.environment(tmp_path_factory.mktemp("cold"))
    first = start(families[0], environment)
    time.sleep(delay)
    second = start(families[1], environment)
    if kill is not None:
        time.sleep(kill)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGKILL)
    code, out, errors = outcome(first)
    assert (code, out) == (0, expected) or (kill is not None and code == -signal.SIGKILL), errors
    assert outcome(second) == (0, expected, "")
