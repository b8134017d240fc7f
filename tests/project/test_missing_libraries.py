"""An absent library causes one line with a command that installs it, and exit code 2."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from support.bags import Writer
from support.command_line import error_of, script
from support.paths import ROOT
from support.room_log import write_room

import gpusense as gs
from gpusense._util import extras
from gpusense.commands import cli

LOCALIZE = ["localize", "--map", "map.yaml", "--log", "run.log", "--range-max", "20", "--backend", "numpy",
            "--particles", "50", "--limit", "2"]  # fmt: skip
# Library, a call that needs it, and the beginning of the message.
CALLS = [
    ("rosbags", ["localize", "--map", "map.yaml", "--log", "run.bag"], "run.bag: a ROS bag needs the library rosbags"),
    ("rosbags", ["match", "--log", "run.mcap"], "run.mcap: a ROS bag needs the library rosbags"),
    ("rerun", [*LOCALIZE, "--record", "run.rrd"],
     "argument --record: a recording for Rerun needs the library rerun-sdk"),
    ("matplotlib", [*LOCALIZE, "--plot", "run.png"], "argument --plot: a picture needs the library matplotlib"),
    ("matplotlib", ["fit", "--map", "map.yaml", "--log", "run.log", "--out", "fitted"],
     "argument --out: a picture needs the library matplotlib"),
    ("matplotlib", ["demo", "--backend", "numpy"],
     "the picture, which --no-plot leaves out, needs the library matplotlib"),
    ("distributed", ["sweep", "plan.yaml", "--dask", "local"], "a sweep on Dask needs the library dask"),
    ("pyarrow", ["sweep", "plan.yaml", "--table", "t.parquet"],
     "a Parquet table, in place of a .csv one, needs the library pyarrow"),
    ("yaml", LOCALIZE, "gpusense needs the library PyYAML"),
    ("PIL", ["localize", "--map", "png.yaml", *LOCALIZE[3:]], "gpusense needs the library Pillow"),
]  # fmt: skip


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with maps, logs and a plan the working directory."""
    write_room(tmp_path, scans=3)
    for kind in ("ros1", "mcap"):
        with Writer(tmp_path, kind) as bag:
            bag.scan(0.0, [1.0, 2.0, 3.0], -0.1, 0.1)
    next((tmp_path / "run").glob("*.mcap")).rename(tmp_path / "run.mcap")
    (tmp_path / "plan.yaml").write_text("axes: {log: {run: {log: run.log, map: map.yaml}}}\n")
    gs.write_map(gs.OccupancyGrid([[0, 100]]), tmp_path / "png.yaml", image_format="png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def block(monkeypatch: pytest.MonkeyPatch):
    """Return a function that makes imports of a library fail, as if it was not installed."""

    def forget(name: str) -> None:
        for module in [each for each in sys.modules if each == name or each.startswith(f"{name}.")]:
            monkeypatch.delitem(sys.modules, module)
        monkeypatch.setitem(sys.modules, name, None)

    return forget


@pytest.mark.parametrize(("name", "argv", "begin"), CALLS)
def test_a_missing_library_is_one_line(place, block, capsys, name, argv, begin):
    before = sorted(place.iterdir())
    block(name)
    message = error_of(argv, capsys)
    requirement = extras.REQUIREMENTS[name]
    assert message.startswith(f"{begin}, which is not installed: ")
    command = message.partition(" is not installed: ")[2]
    assert re.match(rf"(pip|\S+ -m pip) install '?{re.escape(requirement.package)}'?(, or |$)", command)
    if requirement.extra:
        assert command.endswith(f"or in a checkout of gpusense {extras._pip()} install '.[{requirement.extra}]'")
    assert {*place.iterdir()} - {*before} <= {place / "fitted"}


def test_an_interpreter_without_a_library(place):
    done = script(
        "sys.modules['rosbags'] = None\nfrom gpusense.commands.cli import main\n"
        "sys.exit(main(['map', '--log', 'run.bag', '--out', 'new.yaml']))",
        cwd=place,
    )
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith(
        "gpusense: error: run.bag: a ROS bag needs the library rosbags, which is not installed"
    )


def test_a_library_that_does_not_load_says_why(place, monkeypatch, capsys):
    class Broken:
        @staticmethod
        def find_spec(name: str, *_: object) -> None:
            if name.startswith("rosbags"):
                raise ImportError("a part of lz4 is absent")

    for module in [each for each in sys.modules if each.startswith("rosbags")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setattr(sys, "meta_path", [Broken, *sys.meta_path])
    message = error_of(["match", "--log", "run.bag"], capsys)
    assert "needs the library rosbags, which cannot be imported (" in message and "lz4" in message


def test_a_module_of_gpusense_that_is_absent_keeps_its_traceback(place, monkeypatch):
    monkeypatch.delitem(sys.modules, "gpusense.commands.localize", raising=False)
    monkeypatch.setitem(sys.modules, "gpusense.commands.localize_report", None)
    with pytest.raises(ModuleNotFoundError, match="localize_report"):
        cli.main(LOCALIZE)


def test_libraries_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = {name: {Requirement(one).name for one in every} for name, every in project["optional-dependencies"].items()}
    extra[""] = {Requirement(one).name for one in project["dependencies"]}
    for module, needed in extras.REQUIREMENTS.items():
        assert Requirement(needed.package).name in extra[needed.extra], module
    for name in ("dask", "pyarrow"):
        assert extras.REQUIREMENTS[name].extra == "sweep"
    # numpy is always imported, and wheels of drivers are no modules.
    assert {one.package.lower() for one in extras.REQUIREMENTS.values() if not one.extra} == {
        name.lower() for name in extra[""] - {"numpy", "pocl-binary-distribution"}
    }


@pytest.mark.parametrize("own", [True, False])
def test_the_command_is_for_the_running_python(monkeypatch, tmp_path, own):
    python = tmp_path / "a b" / "python"
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setattr(
        extras.shutil, "which", lambda name: str((python if own else tmp_path / "python").parent / name)
    )
    expected = "pip install rosbags" if own else f"'{python}' -m pip install rosbags"
    assert extras.install_command("rosbags.rosbag1") == expected
