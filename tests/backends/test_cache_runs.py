"""Runs with damaged, locked, full, unsafe or shared caches, and with foreign files next to a cache."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import fake_driver
from support.cache_folders import BLOCKED, blocked

from gpusense.backends import scratch

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
    return {path.name: path.stat().st_ino for path in (folder / scratch.OWN).glob("*.gpusense")}


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("family", ["opencl", "warp:cpu"])
def test_a_second_process_compiles_nothing(needs, tmp_path, expected, family):
    """A compiled kernel is stored as an entry; a second process stores none, and neither touches other files. The
    folder is the user's: it also contains other files, with names of gpusense's older caches.
    """
    needs(family.split(":")[0])
    folder, environment = tmp_path / "cold", fake_driver.environment(tmp_path)
    (folder / "run-07").mkdir(parents=True)
    for path in [folder / f"{number}.bin" for number in range(160)]:
        with path.open("wb") as file:
            file.truncate(2 << 20)
    for name in ("notes.tmp", "run-07/lock", "run-07/result.csv"):
        (folder / name).write_text("mine")
    for path in folder.rglob("*"):
        os.utime(path, (time.time() - 1e6,) * 2)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert outcome(start(family, environment)) == (0, expected, "")
    first = entries(folder)
    assert len(first) > 5
    assert outcome(start(family, environment)) == (0, expected, "")
    assert entries(folder) == first
    after = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if scratch.OWN not in path.parts}
    assert after == before and len(before) == 164
    others = [path.name for path in (folder / scratch.OWN).iterdir() if path.suffix != ".gpusense"]
    assert others == [scratch.MARKER]


# The default is the backend that the test of a second process does not use.
@pytest.mark.long
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("family", ["warp:cpu", "opencl"])
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
    "another's contents": lambda data: b"gpusense entry 3\n" + bytes(200),
}


@pytest.mark.slow
@pytest.mark.parametrize("family", ["opencl", "warp:cpu"])
def test_damaged_files_of_every_kind_are_made_anew(needs, tmp_path, expected, family):
    """Damage entries of verdicts, programs, PoCL's and Warp's kernels, and replace entries by folders."""
    needs(family.split(":")[0])
    environment = fake_driver.environment(tmp_path)
    assert outcome(start(family, environment)) == (0, expected, "")
    whole = entries(tmp_path / "cold")
    assert len(whole) >= len(DAMAGES)
    for number, name in enumerate(sorted(whole)):
        path = tmp_path / "cold" / scratch.OWN / name
        path.write_bytes(list(DAMAGES.values())[number % len(DAMAGES)](path.read_bytes()))
    assert outcome(start(family, environment)) == (0, expected, "")
    assert entries(tmp_path / "cold").keys() == whole.keys()
    for name in whole:
        (tmp_path / "cold" / scratch.OWN / name).unlink()
        (tmp_path / "cold" / scratch.OWN / name).mkdir()
    code, out, errors = outcome(start(family, environment))
    assert (code, out, errors.count("\n")) == (0, expected, 1), errors
    assert f"the cache folder {tmp_path / 'cold'} cannot be written" in errors


@pytest.mark.slow
@pytest.mark.parametrize(("family", "how"), [("opencl", BLOCKED[0]), ("opencl", BLOCKED[2]), ("warp:cpu", BLOCKED[1])])
def test_a_cache_that_cannot_be_written_is_named_and_stops_nothing(needs, tmp_path, expected, family, how):
    """The folder of gpusense, and the default folders of PoCL and Warp."""
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
    assert len(list((tmp_path / "tmp").rglob("*.gpusense"))) > 5


@pytest.mark.slow
def test_a_full_file_system_is_named_and_stops_nothing(needs, tmp_path, expected):
    """The cache is a file system of 256 KiB; the folder of the process is elsewhere."""
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
    """Kill processes of each family with their children, half of them during the proof of the device."""
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
