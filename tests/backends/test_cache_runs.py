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
from support import fake_driver

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


@pytest.mark.long
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
