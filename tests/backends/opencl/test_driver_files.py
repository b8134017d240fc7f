"""OpenCL drivers for the loader: the system's, pyopencl's, and Intel's from its wheel."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from support import fake_driver

pytest.importorskip("pyopencl")
from gpusense.backends.opencl import drivers

_CHOICE = drivers.choice


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Imitate a machine with one driver of the system, one of pyopencl, and no child processes."""
    vendors, beside = tmp_path / "vendors", tmp_path / "pyopencl" / ".libs"
    for folder in (vendors, beside):
        folder.mkdir(parents=True)
    (vendors / "gpu.icd").write_text("libgpu.so.1\n")
    (beside / "pocl.icd").write_text("libpocl.so")
    (beside / "libpocl.so").write_text("")
    for name in ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("GPUSENSE_PROOF", "off")
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(drivers, "_SYSTEM", str(vendors))
    monkeypatch.setattr(drivers.cl, "__file__", str(beside.parent / "__init__.py"))
    monkeypatch.setattr(drivers, "_choice", None)
    monkeypatch.setattr(drivers, "_loaded", False)
    monkeypatch.setattr(drivers, "choice", lambda: drivers._chosen())
    monkeypatch.setattr(drivers, "scratch_folder", lambda **_: tmp_path)
    return tmp_path


@pytest.fixture
def intel(machine, monkeypatch):
    """Install a substitute for Intel's wheel."""
    library = machine / "lib" / "libintelocl.so"
    library.parent.mkdir()
    library.write_text("")
    files = [
        SimpleNamespace(name="readme", locate=lambda: machine),
        SimpleNamespace(name=library.name, locate=lambda: library),
    ]
    monkeypatch.setattr(drivers.importlib.metadata, "files", lambda name: files)
    return library


def named(variables: dict[str, str]) -> list[str]:
    return [path.read_text().strip() for path in sorted(Path(variables["OCL_ICD_VENDORS"]).glob("*.icd"))]


def test_without_intels_runtime_the_loader_is_left_alone(machine):
    assert drivers.choice() == drivers.Choice(None)
    assert drivers._variables(None).keys() == {"POCL_CACHE_DIR"}


def test_intels_runtime_joins_the_drivers_that_the_loader_finds_by_itself(machine, intel):
    choice = drivers.choice()
    assert choice.drivers is not None and choice.failure == "" and choice.left_out == ()
    variables = drivers._variables(choice.drivers)
    # A library next to its file is named by its path; the loader finds the system's libraries.
    assert named(variables) == ["libgpu.so.1", str(machine / "pyopencl" / ".libs" / "libpocl.so"), str(intel)]
    assert not (Path(variables["PYOPENCL_HOME"]) / ".libs").exists()


@pytest.mark.parametrize("variable", ["OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"])
def test_a_variable_that_names_a_folder_is_extended(machine, intel, monkeypatch, variable):
    (machine / "mine").mkdir()
    (machine / "mine" / "own.icd").write_text("/opt/own.so\n")
    monkeypatch.setenv(variable, str(machine / "mine"))
    found = named(drivers._variables(drivers.choice().drivers))
    assert found[0] == "/opt/own.so" and found[-1] == str(intel) and len(found) == 3


def test_a_variable_that_names_one_driver_is_obeyed(machine, intel, monkeypatch):
    monkeypatch.setenv("OCL_ICD_VENDORS", str(machine / "vendors" / "gpu.icd"))
    assert drivers.choice() == drivers.Choice(None)


def test_intels_runtime_is_not_named_twice(machine, intel):
    (machine / "vendors" / "intel.icd").write_text(f"{intel}\n")
    assert drivers.choice() == drivers.Choice(None)


@pytest.mark.parametrize("problem", ["not installed", "no library"])
def test_half_a_wheel_is_none(machine, intel, monkeypatch, problem):
    intel.unlink()
    if problem == "not installed":

        def absent(name):
            raise drivers.importlib.metadata.PackageNotFoundError(name)

        monkeypatch.setattr(drivers.importlib.metadata, "files", absent)
    assert drivers.choice() == drivers.Choice(None)


@pytest.fixture
def trials(machine, monkeypatch):
    """Let successive child processes fail as listed; return the list of drivers that each one loaded."""
    failures, loaded = [], []

    def run_text(arguments, job, variables):
        loaded.append(named(variables) if "OCL_ICD_VENDORS" in variables else "all")
        return drivers.probe_process.Outcome([], failures.pop(0))

    monkeypatch.setenv("GPUSENSE_PROOF", "on")
    monkeypatch.setattr(drivers, "_loader", lambda: "libOpenCL.so")
    monkeypatch.setattr(drivers.probe_process, "run_text", run_text)
    return failures, loaded


def test_a_verdict_on_loading_is_kept_and_made_anew_when_asked(trials, monkeypatch, caplog):
    """``gpusense devices --prove`` tries the loading of drivers again."""
    failures, loaded = trials
    failures += ["ends the process", "", "ends the process", ""]
    monkeypatch.setattr(drivers, "choice", _CHOICE)
    chosen = drivers.choice()
    ((name, reason),) = chosen.left_out
    assert name.endswith("pocl.icd") and reason == "ends the process"
    assert len(loaded) == 4 and loaded[0] == "all" and caplog.messages[0].endswith("is left out: it ends the process")
    monkeypatch.setattr(drivers, "_choice", None)
    assert drivers.choice() == chosen and len(loaded) == 4
    # The driver was repaired.
    failures.append("")
    drivers.renew()
    assert drivers.choice() == drivers.Choice(None) and loaded[4:] == ["all"]
    monkeypatch.setattr(drivers, "_choice", None)
    assert drivers.choice() == drivers.Choice(None) and len(loaded) == 5


def test_a_process_keeps_the_drivers_that_it_has_loaded(trials, monkeypatch):
    """Selection strings of the process and of its children number the devices of these drivers."""
    failures, loaded = trials
    monkeypatch.setattr(drivers, "choice", _CHOICE)
    failures.append("")
    chosen = drivers.choice()
    monkeypatch.setattr(drivers, "_loaded", True)
    failures += ["ends the process", "", "ends the process", ""]
    drivers.renew()
    assert drivers.choice() is chosen and len(loaded) == 5
    monkeypatch.setattr(drivers, "_choice", None)
    assert len(drivers.choice().left_out) == 1 and len(loaded) == 5


def test_variables_are_set_back(monkeypatch):
    monkeypatch.setenv("GPUSENSE_TEST_SET", "before")
    monkeypatch.delenv("GPUSENSE_TEST_UNSET", raising=False)
    with drivers._environment({"GPUSENSE_TEST_SET": "1", "GPUSENSE_TEST_UNSET": "2"}):
        assert (os.environ["GPUSENSE_TEST_SET"], os.environ["GPUSENSE_TEST_UNSET"]) == ("1", "2")
    assert os.environ["GPUSENSE_TEST_SET"] == "before" and "GPUSENSE_TEST_UNSET" not in os.environ


_LISTED = """
import json, os
import gpusense as gs
before = dict(os.environ)
found = [d.selection for d in gs.devices() if d.backend == "opencl" and d.kind == "cpu" and d.available]
changed = {name for name in before.keys() | os.environ.keys() if before.get(name) != os.environ.get(name)}
print(json.dumps([found, sorted(changed - {"PYOPENCL_HOME"})]))
"""


@pytest.mark.slow
def test_a_runtime_from_a_wheel_is_found_proved_and_used_beside_pocl(needs, tmp_path):
    """A wheel of the name contains a substitute for Intel's library."""
    needs("opencl")
    wheel = tmp_path / "site"
    (wheel / "intel_opencl_rt-1.0.dist-info").mkdir(parents=True)
    (wheel / "intel_opencl_rt-1.0.dist-info" / "METADATA").write_text("Name: intel-opencl-rt\nVersion: 1.0\n")
    (wheel / "intel_opencl_rt-1.0.dist-info" / "RECORD").write_text("libintelocl.so,,\n")
    built = Path(fake_driver.build(tmp_path, "").read_text().strip())
    built.rename(wheel / "libintelocl.so")
    listed = []
    for search in ("", str(wheel)):
        environment = fake_driver.environment(tmp_path, PYTHONPATH=search)
        done = subprocess.run([sys.executable, "-P", "-c", _LISTED], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        found, changed = json.loads(done.stdout)
        assert changed == []
        listed.append(found)
    assert len(listed[1]) == len(listed[0]) + 1
