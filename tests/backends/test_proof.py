"""Failing drivers end no user's process: verdicts, the order of fallback settings, and compiled fake drivers."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys

import pytest
from support import fake_driver

import gpusense as gs
from gpusense._util import files
from gpusense.backends import BackendInfo, get_backend, probe_process, proof, selection
from gpusense.backends.probe_process import Outcome
from gpusense.backends.proof import FLOAT64, SCALAR, VECTORS, DeviceCheck, verdict_on

INFO = BackendInfo("opencl:0:0", "opencl", "Some device", "cpu", "Driver 1", 1 << 30, 1 << 28, True, 16)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Use a private cache, and forget the verdicts of this process."""
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(tmp_path / "cache"))
    for name in ("GPUSENSE_CACHE", "GPUSENSE_PROOF", "GPUSENSE_PROOF_SECONDS", "GPUSENSE_BACKEND"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(proof, "_known", {})
    monkeypatch.setattr(selection, "_looks", ((), {}))
    return tmp_path


@pytest.fixture
def driver(monkeypatch):
    """Return a function that makes a driver with failing families, and records the tried settings."""
    tried: list[tuple[int, bool]] = []

    def make(fails: dict[tuple[str, int], str], conclusive: bool = True) -> list[tuple[int, bool]]:
        def run(job):
            info = BackendInfo(**job["info"])
            tried.append((info.lanes, info.float64))
            said = []
            families = [SCALAR, *([FLOAT64] if info.float64 else []), VECTORS if info.lanes > 1 else SCALAR]
            for turn, family in enumerate(families):
                said.append({"begin": family})
                lanes = info.lanes if turn == len(families) - 1 else 0
                if how := fails.get((family, lanes)):
                    if how.startswith("wrong"):
                        return Outcome([*said, {"wrong": how}])
                    return Outcome(said, how, conclusive)
            return Outcome([*said, {"rate": 100.0}, {"end": True}])

        monkeypatch.setattr(probe_process, "run", run)
        return tried

    return make


def test_a_good_driver_is_proved_once(driver):
    tried = driver({})
    assert verdict_on(INFO) == DeviceCheck(True, 16, True, rate=100.0)
    proof._known.clear()
    assert verdict_on(INFO) == DeviceCheck(True, 16, True, rate=100.0)
    assert tried == [(16, True)]


ABORT = "ends the process with SIGABRT (LLVM ERROR: no)"


@pytest.mark.parametrize(
    ("fails", "tried", "left"),
    [
        ({(VECTORS, 16): ABORT}, [(16, True), (8, True)], (True, 8, True)),
        ({(VECTORS, 16): ABORT, (VECTORS, 8): "wrong"}, [(16, True), (8, True), (1, True)], (True, 1, True)),
        ({(FLOAT64, 0): "wrong: ranges"}, [(16, True), (16, False)], (True, 16, False)),
        ({(FLOAT64, 0): ABORT, (VECTORS, 16): "wrong"}, [(16, True), (16, False), (8, False)], (True, 8, False)),
        ({(SCALAR, 0): ABORT}, [(16, True)], (False, 1, False)),
        ({(VECTORS, 16): ABORT, (VECTORS, 8): ABORT, (SCALAR, 1): ABORT}, [(16, True), (8, True), (1, True)],
         (False, 1, False)),
    ],
)  # fmt: skip
def test_a_setting_that_fails_gives_way_to_the_next_more_modest_one(driver, caplog, fails, tried, left):
    asked = driver(fails)
    verdict = verdict_on(INFO)
    assert asked == tried
    assert (verdict.usable, verdict.lanes, verdict.float64) == left
    for family, lanes in fails:
        assert (f"{family} of {lanes}" if family == VECTORS else family) in verdict.reason
    assert proof.with_remedy(verdict.reason) > verdict.reason
    (line,) = caplog.messages
    assert "opencl:0:0 (Some device, Driver 1)" in line and verdict.reason in line and "\n" not in line
    left_info = proof.apply(INFO, verdict)
    assert (left_info.lanes, left_info.float64) == left[1:]
    # The verdict is reported once, and stored.
    proof._known.clear()
    assert verdict_on(INFO) == verdict
    assert asked == tried and len(caplog.messages) == 1


@pytest.mark.parametrize("changed", ["driver", "name", "lanes", "target", "version", "processor"])
def test_a_verdict_is_made_anew_when_its_key_changes(driver, monkeypatch, changed):
    tried = driver({})
    verdict_on(INFO)
    if changed == "version":
        monkeypatch.setattr(proof, "__version__", "99")
    elif changed == "processor":
        monkeypatch.setattr(proof, "fingerprint", lambda: "another")
    else:
        verdict_on(dataclasses.replace(INFO, **{changed: 8 if changed == "lanes" else "another"}))
    verdict_on(INFO)
    assert len(tried) == 2
    verdict_on(dataclasses.replace(INFO, selection="opencl:3:0"))
    assert len(tried) == 2
    verdict_on(INFO, anew=True)
    assert len(tried) == 3


def test_a_hang_lasts_once_it_has_happened_in_two_processes(driver):
    """A temporarily busy machine does not lose a device permanently."""
    tried = driver({(VECTORS, 16): "hangs: no answer in 60 s"})
    for _ in range(3):
        proof._known.clear()
        assert verdict_on(INFO).lanes == 8
        verdict_on(INFO)
    assert tried == 2 * [(16, True), (8, True)]
    verdict_on(INFO, anew=True)
    proof._known.clear()
    verdict_on(INFO)
    assert tried == 4 * [(16, True), (8, True)]


def test_a_child_that_something_else_ended_is_no_lasting_verdict(driver):
    tried = driver({(SCALAR, 0): "ends the process with SIGKILL"}, conclusive=False)
    assert not verdict_on(INFO).usable
    assert not verdict_on(INFO).usable
    assert len(tried) == 1
    proof._known.clear()
    verdict_on(INFO)
    assert len(tried) == 2


@pytest.mark.parametrize("state", ["OSError: No space left on device", "MemoryError", "database or disk is full"])
def test_a_state_of_the_machine_is_no_lasting_verdict(driver, state):
    tried = driver({(SCALAR, 0): state})
    for _ in range(2):
        assert not verdict_on(INFO).usable
        proof._known.clear()
    assert len(tried) == 2


def test_a_crash_after_the_end_of_a_proof_condemns_no_device(monkeypatch):
    said = [{"begin": SCALAR}, {"rate": 5.0}, {"end": True}]
    monkeypatch.setattr(probe_process, "run", lambda job: Outcome(said, "ends the process with SIGSEGV"))
    assert verdict_on(INFO) == DeviceCheck(True, 16, True, rate=5.0)


def test_a_damaged_verdict_is_made_anew(driver, folder):
    tried = driver({})
    verdict_on(INFO)
    (entry,) = (folder / "cache").rglob("*.gpusense")
    for damage in (b"", entry.read_bytes()[:-3], bytes(100)):
        entry.write_bytes(damage)
        proof._known.clear()
        assert verdict_on(INFO).usable
    assert len(tried) == 4


def test_proofs_can_be_switched_off(driver, monkeypatch):
    tried = driver({(SCALAR, 0): ABORT})
    monkeypatch.setenv("GPUSENSE_PROOF", "off")
    assert verdict_on(INFO) == proof.trust(INFO) == DeviceCheck(True, 16, True)
    assert tried == []


def test_a_system_that_starts_no_child_leaves_devices_usable(monkeypatch, caplog):
    """The driver is not at fault: this process trusts it, and the next one proves it."""
    monkeypatch.setattr(sys, "executable", "/nowhere/python3")
    for _ in range(2):
        assert verdict_on(INFO) == proof.trust(INFO)
    (line,) = caplog.messages
    assert "opencl:0:0 (Some device, Driver 1) is trusted without a proof: no child process can be started: " in line
    assert caplog.records[0].levelname == "WARNING"
    assert proof._load(proof._key(INFO)) is None


def test_no_room_for_the_output_of_a_child_is_no_failure_of_a_driver(monkeypatch, caplog):
    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.tempfile, "TemporaryFile", full)
    monkeypatch.setattr(files.os, "memfd_create", full, raising=False)
    assert verdict_on(INFO) == proof.trust(INFO)
    assert "no child process can be started: [Errno 28] No space left on device" in caplog.messages[-1]


def test_settings_that_failed_before_the_last_child_stay_off(monkeypatch, caplog):
    outcomes = iter([Outcome([{"begin": VECTORS}], ABORT), Outcome([], "no child", conclusive=False, started=False)])
    monkeypatch.setattr(probe_process, "run", lambda job: next(outcomes))
    verdict = verdict_on(INFO)
    assert (verdict.usable, verdict.lanes) == (True, 8) and "kernels in vectors of 16 end the process" in verdict.reason


def test_a_frozen_program_trusts_devices_and_says_so(driver, monkeypatch, caplog):
    """It trusts only without a proof by a program with an interpreter."""
    caplog.set_level("INFO")
    tried = driver({(VECTORS, 16): ABORT})
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    for _ in range(2):
        assert verdict_on(INFO, anew=True) == proof.trust(INFO)
    (record,) = caplog.records
    assert record.levelname == "INFO" and "is trusted without a proof: a frozen program has no" in record.getMessage()
    monkeypatch.delattr(sys, "frozen")
    proof._known.clear()
    proved = verdict_on(INFO)
    assert proved.lanes == 8 and len(tried) == 2
    proof._known.clear()
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert verdict_on(INFO, anew=True) == proved and len(tried) == 2


@pytest.mark.long
@pytest.mark.sampled(0.2)
@pytest.mark.parametrize(
    ("family", "lanes", "float64"),
    [("opencl", 8, False), ("opencl", 16, True), ("warp", 1, True)],
)
def test_the_scene_passes_on_real_devices_with_every_setting(needs, family, lanes, float64):
    """In this process, with less time for the rate."""
    from gpusense.evaluation import proof as scene

    needs(family)
    device = next(d for d in gs.devices() if d.backend == family and d.kind != "simulator" and d.available)
    info = dataclasses.replace(gs.backends.get_backend(device.selection).info, lanes=lanes, float64=float64)
    said = []
    scene.prove({"info": dataclasses.asdict(info)}, said.append)
    assert said[-1] == {"end": True}
    assert said[-2]["rate"] > 0
    begun = [report["begin"] for report in said if "begin" in report]
    assert (FLOAT64 in begun) == float64
    assert (VECTORS in begun) == (lanes > 1)


@pytest.mark.slow
def test_a_driver_that_ends_long_loops_early_is_unusable(needs, monkeypatch):
    """Mesa's llvmpipe ends all loops of a work-group after 65 535 steps; small scenes do not show it."""
    from gpusense.evaluation import proof as scene

    info, right = get_backend(needs("opencl")).info, scene.distance_transform

    def cut(cells, *, squared, backend):
        found = right(cells, squared=squared, backend=backend)
        if backend.info.backend == "opencl":
            found.ravel()[: max(cells.shape[1] - 30_000, 0)] = 0
        return found

    monkeypatch.setattr(scene, "distance_transform", cut)
    said = []
    scene.prove({"info": dataclasses.asdict(info)}, said.append)
    assert said[0] == {"begin": SCALAR}
    assert said[-1]["wrong"].startswith("1 x 32767 cells, distance transform: 2723 cells that differ")


# ---- drivers that really fail


_DEFAULT = """
import json, sys
import numpy as np, gpusense as gs
from gpusense.backends import get_backend
cells = np.zeros((20, 20), int); cells[5] = 100
info = get_backend("auto").info
distance = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), 10.0).cast([[2.5, 1.5, 1.5707963267948966]], [0.0])[0, 0]
try:
    get_backend("opencl"); named = ""
except ValueError as error:
    named = str(error)
print(json.dumps({"selection": info.selection, "lanes": info.lanes, "float64": info.float64,
                  "distance": float(distance), "named": named}))
"""


def default_of(tmp_path, **variables):
    """Return the default backend of a process, OpenCL by name, with a cold and a warm cache, and its messages."""
    seconds = {"GPUSENSE_PROOF_SECONDS": os.environ.get("GPUSENSE_PROOF_SECONDS", "60")}
    environment = fake_driver.environment(tmp_path, **seconds | variables)
    runs = [
        subprocess.run([sys.executable, "-P", "-c", _DEFAULT], capture_output=True, text=True, env=environment)
        for _ in range(2)
    ]
    assert [run.returncode for run in runs] == [0, 0], runs[0].stderr
    first, again = (json.loads(run.stdout.splitlines()[-1]) for run in runs)
    assert first == again and first["distance"] == 3.5
    # The message comes once, with the verdict.
    assert runs[1].stderr == ""
    return first, runs[0].stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "words", "message"),
    [
        ("abort", ["distance"], "is unusable: scalar kernels end the process with SIGABRT"),
        ("hang", ["distance"], "is unusable: scalar kernels hang: no answer in 8 s"),
        (
            "wrong",
            ["OBSTACLE : i - nearest", "OBSTACLE : i + nearest"],
            "is unusable: scalar kernels compute wrong",
        ),
    ],
)
def test_a_driver_that_fails_altogether_is_named_and_another_backend_is_the_default(
    needs, tmp_path, mode, words, message
):
    needs("opencl")
    needs("warp")
    icd = fake_driver.build(tmp_path, mode, *words)
    limit = {}
    if mode == "hang":
        # Warp is proved beforehand, as it may take longer.
        proved = [sys.executable, "-P", "-c", "from gpusense.backends import get_backend; get_backend('warp:cpu')"]
        subprocess.run(proved, env=fake_driver.environment(tmp_path), check=True)
        limit = {"GPUSENSE_PROOF_SECONDS": "8"}
    found, errors = default_of(tmp_path, OCL_ICD_VENDORS=str(icd), **limit)
    assert found["selection"] == "warp:cpu"
    assert errors.count("\n") == 1 and message in errors and "GPUSENSE_BACKEND" in errors
    assert message in found["named"] and found["named"].startswith("backend: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "words", "message", "left"),
    [
        ("refuse", ["cl_khr_fp64"], "float64 kernels fail", (None, False)),
        ("wrong", ["return log_lanes(p)", "return exp_lanes(p)"], "kernels in vectors of 8 compute wrong", (1, True)),
    ],
)
def test_a_driver_that_fails_in_part_keeps_the_rest(needs, tmp_path, mode, words, message, left):
    """One driver claims float64 without support; the other has wrong vectors."""
    needs("opencl")
    icd = fake_driver.build(tmp_path, mode, *words)
    found, errors = default_of(tmp_path, OCL_ICD_VENDORS=str(icd))
    assert found["selection"] == "opencl:0:0" and found["named"] == ""
    assert found["float64"] == left[1] and left[0] in (None, found["lanes"])
    assert errors.count("\n") == 1 and message in errors


@pytest.mark.slow
def test_a_fake_that_fails_nowhere_is_usable(needs, tmp_path):
    """The tests above rely on this one."""
    needs("opencl")
    found, errors = default_of(tmp_path, OCL_ICD_VENDORS=str(fake_driver.build(tmp_path, "")))
    assert (found["selection"], found["named"], errors) == ("opencl:0:0", "", "")
    assert found["lanes"] > 1 and found["float64"]


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "end"), [("load", "SIGABRT"), ("exit", "exit code 0, without an answer")])
def test_a_driver_that_dies_when_it_is_loaded_is_left_out_and_the_others_work(needs, tmp_path, mode, end):
    """PoCL, installed with pyopencl, is still present."""
    needs("opencl")
    icd = fake_driver.build(tmp_path, mode)
    found, errors = default_of(tmp_path, OCL_ICD_VENDORS=str(icd.parent))
    assert found["selection"].startswith("opencl:") and found["named"] == ""
    assert errors.count("\n") == 1 and f"{icd} is left out: it ends the process with {end}" in errors
    environment = fake_driver.environment(tmp_path, OCL_ICD_VENDORS=str(icd.parent))
    command = [sys.executable, "-P", "-m", "gpusense", "devices"]
    listed = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert listed.returncode == 0
    assert any(line.startswith(f"{icd}: it ends the process with {end}") for line in listed.stdout.splitlines())


@pytest.mark.slow
def test_without_a_linker_pocl_says_what_to_install(needs, tmp_path):
    """PoCL needs the system's linker, and aborts without it."""
    needs("opencl")
    fake_driver.pocl_library()
    found, errors = default_of(tmp_path, PATH=str(tmp_path))
    assert found["selection"] == "warp:cpu"
    assert "install the linker ld (on Debian: apt-get install binutils), then run 'gpusense devices --prove'" in errors


def test_a_variable_that_names_nothing_is_an_error_that_names_it(monkeypatch):
    monkeypatch.setenv("GPUSENSE_BACKEND", "vulkan")
    with pytest.raises(ValueError, match=r"GPUSENSE_BACKEND: backend: must be 'auto'.* got 'vulkan'"):
        gs.backends.get_backend("auto")
    assert gs.backends.get_backend("numpy").info.backend == "numpy"
