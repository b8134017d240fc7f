"""The package for colcon: its entry points, launch file and manifest, without ROS."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from types import ModuleType
from typing import Any

import pytest
from support.paths import ROOT

import gpusense as gs
from gpusense.ros import conversions

PACKAGE = ROOT / "examples" / "ros2" / "gpusense_localization"
NODES = ROOT / "gpusense" / "ros" / "nodes"
LAUNCH = PACKAGE / "launch" / "localize.launch.py"


class Recorded:
    """An object of a launch file that only holds its arguments."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments, self.options = arguments, options


def description(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what the launch file starts, without ROS's package launch, which no wheel has."""
    for node in ast.parse(LAUNCH.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in ("launch",
                "launch_ros", "ament_index_python"):  # fmt: skip
            parts = node.module.split(".")
            for k in range(1, len(parts) + 1):
                name = ".".join(parts[:k])
                monkeypatch.setitem(sys.modules, name, sys.modules.get(name) or ModuleType(name))
            for each in node.names:
                vars(sys.modules[node.module])[each.name] = type(each.name, (Recorded,), {})
    sys.modules["ament_index_python.packages"].get_package_share_directory = lambda name: f"/share/{name}"
    spec = importlib.util.spec_from_file_location("launched", LAUNCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description().arguments[0]


def test_the_launch_file_starts_nodes_with_parameters_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    found = description(monkeypatch)
    declared = {one.arguments[0]: one.options["default_value"] for one in found if "package" not in one.options}
    assert (PACKAGE / declared["parameters"].removeprefix(f"/share/{PACKAGE.name}/")).is_file()
    nodes = {one.options["executable"]: one.options for one in found if "package" in one.options}
    names = {"localize": conversions.defaults(), "watch": conversions.WATCH}
    assert nodes.keys() == names.keys()
    for executable, options in nodes.items():
        (given,) = options["parameters"]
        assert given.keys() <= names[executable].keys() | {"use_sim_time"}
        assert {value.arguments[0].arguments[0] for value in given.values()} <= declared.keys()


def test_entry_points_and_files_exist() -> None:
    setup = (PACKAGE / "setup.py").read_text()
    scripts = dict(re.findall(r'\("(\w+)", "(\w+)"\)', setup))
    assert scripts == {"localize": "localization", "watch": "watching"}
    for module in scripts.values():
        assert "def main(" in (NODES / f"{module}.py").read_text()
    for file in re.findall(r'\["([\w/.]+)"\]', setup):
        assert (PACKAGE / file).is_file()
    assert gs.compat.from_nav2(PACKAGE / "config" / "amcl.yaml").ignored == ()
    (name,) = re.findall(r"parameters:=\$PWD/src/(\S+)", (PACKAGE / "README.md").read_text())
    assert (PACKAGE.parent / name).is_file()


def test_the_manifest_names_what_is_imported() -> None:
    nodes = [node for file in [*NODES.glob("*.py"), LAUNCH] for node in ast.walk(ast.parse(file.read_text()))]
    modules = {node.module.partition(".")[0] for node in nodes if isinstance(node, ast.ImportFrom)}
    modules |= {name.name.partition(".")[0] for node in nodes if isinstance(node, ast.Import) for name in node.names}
    others = modules - {*sys.stdlib_module_names, "gpusense", "numpy"}
    named = set(re.findall(r"<exec_depend>(\w+)</exec_depend>", (PACKAGE / "package.xml").read_text()))
    assert others == named
