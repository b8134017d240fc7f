"""The default device is the fastest that opens, and is looked up once."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import pytest
from support import fake_driver

from gpusense._util import notices
from gpusense.backends import Device, default_failures, get_backend, listing, selection
from gpusense.backends.numpy.backend import NumpyBackend
from gpusense.backends.proof import DeviceCheck

GPU = Device("opencl", "A GPU", "gpu", True, "", "opencl:0:0", "Driver 1")
CPU = Device("opencl", "A CPU", "cpu", True, "", "opencl:1:0", "Driver 2")
WARP = Device("warp", "CPU", "cpu", True, "", "warp:cpu", "Warp 1")
NUMPY = Device("numpy", "NumPy reference", "cpu", True, "", "numpy")


@pytest.fixture
def machine(monkeypatch):
    """Return a function that imitates a machine's devices, some of which fail; it returns the list of opened ones.

    A failure is an error at opening, or a verdict.
    """
    monkeypatch.delenv("GPUSENSE_BACKEND", raising=False)
    opened: list[str] = []

    def make(devices, failures, absent=()):
        def open_one(name):
            opened.append(name)
            if isinstance(failure := failures.get(name), Exception):
                raise failure
            return NumpyBackend(dataclasses.replace(NumpyBackend().info, selection=name))

        def verdict_of(device):
            failure = failures.get(device.selection)
            return failure if isinstance(failure, DeviceCheck) else DeviceCheck(True, 1, True, rate=1.0)

        parts = [Device(name, f"{name} (no device)", "cpu", False, reason, "") for name, reason in absent]
        monkeypatch.setattr(
            listing,
            "present",
            lambda entry: tuple([d for d in rows if d.backend == entry.name] for rows in ([*devices, NUMPY], parts)),
        )
        monkeypatch.setattr(listing, "_verdict_of", verdict_of)
        monkeypatch.setattr(selection, "_open", open_one)
        monkeypatch.setattr(selection, "_looks", ((), {}))
        monkeypatch.setattr(selection, "_passed_over", [])
        return opened

    return make


BROKEN = RuntimeError("clCreateContext failed:\nOUT_OF_RESOURCES")
KEPT = DeviceCheck(False, 1, False, "scalar kernels fail")
PASSING = dataclasses.replace(KEPT, reason="no folder", passing=True)


@pytest.mark.parametrize(
    ("failures", "chosen", "tried"),
    [
        ({}, "opencl:0:0", ["opencl:0:0"]),
        ({"opencl:0:0": BROKEN}, "opencl:1:0", ["opencl:0:0", "opencl:1:0"]),
        ({"opencl:0:0": KEPT, "opencl:1:0": BROKEN}, "warp:cpu", ["opencl:1:0", "warp:cpu"]),
        (dict.fromkeys(("opencl:0:0", "opencl:1:0", "warp:cpu"), BROKEN), "numpy", None),
    ],
)
def test_what_does_not_open_gives_way_to_the_next_slower_device(machine, failures, chosen, tried):
    opened = machine([GPU, CPU, WARP], failures)
    assert get_backend("auto").info.selection == chosen
    assert opened == (tried or ["opencl:0:0", "opencl:1:0", "warp:cpu", "numpy"])
    assert {name for name, _ in default_failures()} == set(failures)


@pytest.mark.parametrize("kind", [BROKEN, PASSING])
def test_one_line_says_what_failed_and_why(machine, caplog, kind):
    machine([GPU, WARP], {"opencl:0:0": kind})
    get_backend("auto")
    get_backend("auto")
    (line,) = caplog.messages
    assert line.startswith("gpusense: 'auto' is warp:cpu (CPU): opencl:0:0 (A GPU, Driver 1)") and "\n" not in line
    assert "clCreateContext failed: OUT_OF_RESOURCES" in line or "is unusable: no folder; update the driver" in line
    assert caplog.records[0].levelname == "WARNING"


def test_a_verdict_is_reported_by_the_process_that_makes_it(machine, caplog):
    """Later processes with another compiled device are silent."""
    machine([GPU, WARP], {"opencl:0:0": KEPT})
    assert get_backend("auto").info.selection == "warp:cpu" and caplog.messages == []
    text = "opencl:0:0 (A GPU, Driver 1) is unusable: scalar kernels fail; update the driver"
    made = listing.FallbackOrder([listing.Failure("opencl:0:0", "", text, True)])
    held = ["another warning", text]
    made.report(WARP, held)
    assert held == ["another warning", f"'auto' is warp:cpu (CPU): {text}"]


def test_an_installed_backend_without_devices_is_named_where_nothing_else_is_left(machine, caplog):
    reason = "no driver offers a device: unset this variable"
    machine([], {}, [("opencl", reason), ("warp", "the devices of warp cannot be listed: no folder")])
    assert get_backend("auto").info.selection == "numpy"
    (line,) = caplog.messages
    assert f"opencl (no device): {reason}; warp (no device): the devices of warp cannot be listed: no folder" in line


def test_a_device_that_is_named_is_not_replaced(machine, monkeypatch):
    machine([GPU, WARP], {"opencl:0:0": BROKEN})
    with pytest.raises(RuntimeError, match="OUT_OF_RESOURCES"):
        get_backend("opencl")
    monkeypatch.setenv("GPUSENSE_BACKEND", "opencl:0:0")
    with pytest.raises(RuntimeError, match="OUT_OF_RESOURCES"):
        get_backend("auto")
    assert default_failures() == []


def test_where_not_even_numpy_opens_all_failures_are_named(machine):
    machine([WARP], dict.fromkeys(("warp:cpu", "numpy"), BROKEN))
    with pytest.raises(ValueError, match=r"no device is usable, got 'auto': warp:cpu .* does not open.*; numpy .*"):
        get_backend("auto")


def test_an_interrupt_is_no_failure_of_a_device(machine, monkeypatch, caplog):
    machine([GPU, WARP], {})

    def interrupted(name):
        notices.warn("something else")
        raise KeyboardInterrupt

    monkeypatch.setattr(selection, "_open", interrupted)
    with pytest.raises(KeyboardInterrupt):
        get_backend("auto")
    assert caplog.messages == ["gpusense: something else"]


def test_a_library_that_fails_to_list_its_devices_is_absent(monkeypatch):
    library = listing.registry.load(listing.registry.BY_NAME["numpy"])[0]

    def fail():
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(library, "list_devices", fail)
    (device,) = listing._devices_of(listing.registry.BY_NAME["numpy"], anew=False)
    assert (device.available, device.selection) == (False, "")
    assert device.reason == "the devices of numpy cannot be listed: [Errno 30] Read-only file system"


# ---- a single look-up


@pytest.fixture
def looks(machine, monkeypatch):
    """Return the list of look-ups of the default device."""
    machine([], {})
    seen, real = [], listing.present
    monkeypatch.setattr(listing, "present", lambda entry: seen.append(entry.name) or real(entry))
    return seen


def test_a_process_looks_once(looks):
    first = get_backend("auto")
    count = len(looks)
    assert count and all(get_backend("auto") is first for _ in range(5)) and len(looks) == count
    get_backend("numpy")
    more = len(looks)
    assert more > count and get_backend("numpy").info.selection == "numpy" and len(looks) == more


@pytest.mark.parametrize("variable", selection.VARIABLES)
def test_a_change_of_a_variable_looks_anew(looks, monkeypatch, variable):
    monkeypatch.delenv(variable, raising=False)
    get_backend("auto")
    for value in ("numpy", "auto") if variable == "GPUSENSE_BACKEND" else ("one", "another"):
        count = len(looks)
        monkeypatch.setenv(variable, value)
        found = get_backend("auto")
        assert len(looks) > count and (value != "numpy" or found.info.selection == "numpy"), value
    count = len(looks)
    monkeypatch.delenv(variable)
    get_backend("auto")
    assert len(looks) > count
    monkeypatch.setenv("HOLIDAY", "today")
    count = len(looks)
    get_backend("auto")
    assert len(looks) == count


def test_a_forked_process_looks_anew(looks, monkeypatch):
    get_backend("auto")
    count = len(looks)
    child = os.getpid() + 1
    # The child would refuse a device that the parent has opened.
    monkeypatch.setattr(selection, "_OPENED", [])
    monkeypatch.setattr(os, "getpid", lambda: child)
    get_backend("auto")
    assert len(looks) > count


def test_a_failed_look_is_not_kept(machine, monkeypatch):
    opened = machine([], {"numpy": BROKEN})
    for count in (1, 2):
        with pytest.raises(ValueError, match="no device is usable"):
            get_backend("auto")
        assert len(opened) == count


# ---- whole runs on machines that refuse


_SMALL = """
import numpy as np, gpusense as gs
cells = np.zeros((20, 20), int); cells[5] = 100
model = gs.BeamModel(gs.OccupancyGrid(cells, 1.0), gs.Scanner([0.0, 0.1], range_max=10.0))
print(model.device.selection, np.round(model.log_likelihood([[2.5, 1.5, 1.5]], [3.5, 3.4]), 3).tolist())
for name in ("opencl:portable", "warp:cpu"):
    try:
        gs.backends.get_backend(name)
        print("opened")
    except ValueError as error:
        print(str(error).startswith("backend: "))
"""
# File systems of containers: both are read-only; the second has a temporary folder mounted without execution.
_MOUNTS = """
set -e
mount --make-rprivate /
mount --bind / /
mount -o remount,bind,ro /
for folder in /tmp /var/tmp /dev/shm; do mount -t tmpfs -o ro tmpfs $folder; done
[ "$1" = read-only ] || mount -t tmpfs -o noexec tmpfs /tmp
shift
cd /
exec "$@"
"""


def in_container(kind: str, *command: str) -> subprocess.CompletedProcess[str]:
    """Run Python with file systems like a container's; skip the test without permission."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root of Linux mounts file systems")
    dropped = ("GPUSENSE_CACHE_DIR", "XDG_CACHE_HOME", "TMPDIR", "GPUSENSE_BACKEND", "OCL_ICD_VENDORS")
    environment = {name: value for name, value in os.environ.items() if name not in dropped}
    shell = ["unshare", "-m", "sh", "-c", _MOUNTS, "sh", kind]
    if subprocess.run([*shell, "true"], capture_output=True).returncode:
        pytest.skip("this user may not mount file systems")
    if subprocess.run([*shell, sys.executable, "-c", ""], capture_output=True).returncode == 127:
        pytest.skip("the environment of these tests is in a folder that the container replaces")
    return subprocess.run([*shell, sys.executable, *command], capture_output=True, text=True, env=environment)


@pytest.mark.parametrize(
    ("kind", "chosen"), [("read-only", "numpy"), pytest.param("no execution", "warp:cpu", marks=pytest.mark.slow)]
)
def test_a_container_without_a_folder_for_code_has_a_slower_device(needs, kind, chosen):
    for name in ("opencl", "warp"):
        needs(name)
    done = in_container(kind, "-P", "-c", _SMALL)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split()[0] == chosen and lines[-2:] == ["True", "opened" if chosen == "warp:cpu" else "True"]
    said = [line for line in done.stderr.splitlines() if "'auto' is" in line]
    assert len(said) == 1 and said[0].startswith(f"gpusense: 'auto' is {chosen}")
    assert "compiled kernels need a folder that takes 16 MiB and from which code may run" in said[0]
    # Nothing is compiled: no other line is necessary.
    assert len(done.stderr.splitlines()) <= (1 if chosen == "numpy" else 2), done.stderr
    listed = in_container(kind, "-P", "-m", "gpusense", "devices")
    assert listed.returncode == 0, listed.stderr
    rows = listed.stdout.splitlines()
    assert [row.split()[1] for row in rows if row.startswith("*  ")] == [chosen]
    assert not any("PoCL" in row and row.endswith(" available") for row in rows)
    assert chosen == "warp:cpu" or not any("warp" in row and row.endswith(" available") for row in rows)


_FIRST = """
import sys, pyopencl as cl
platform = next(one for one in cl.get_platforms() if "Portable" in one.name)
queue = cl.CommandQueue(cl.Context(platform.get_devices()))
from gpusense.backends import get_backend
try:
    print(get_backend(queue).info.selection)
except ValueError as error:
    print(error)
"""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give folders away")
def test_pocl_that_a_program_has_loaded_must_keep_its_kernels_where_only_this_user_writes(needs, tmp_path):
    """PoCL loads libraries from the folder that it chose on loading."""
    needs("opencl")
    fake_driver.pocl_library()
    environment = fake_driver.environment(tmp_path, GPUSENSE_PROOF="off")
    for owner in (0, 65534):
        (tmp_path / "xdg").mkdir(exist_ok=True)
        os.chown(tmp_path / "xdg", owner, -1)
        done = subprocess.run([sys.executable, "-c", _FIRST], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        if owner == 0:
            assert done.stdout.startswith("opencl:")
        else:
            assert "is unusable: PoCL was used before gpusense and loads kernels from" in done.stdout
            assert f"{tmp_path / 'xdg'}, which holds pocl, must be owned by this user" in done.stdout
