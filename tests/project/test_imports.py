"""Imports of the package form no circle, including imports in functions, under TYPE_CHECKING and by ``importlib``.

The linter enforces the order of rooms, but does not see names of modules in strings. Here a string that names a
module, as in a table of lazy imports, counts as its import, and an f-string as imports of all matching modules.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import pytest
from support.paths import ROOT

Graph = dict[str, set[str]]
PACKAGE = "gpusense"
# Strings that name a module without importing it, by module and pattern, with the reason.
NO_IMPORTS = {
    ("gpusense.backends.proof", "gpusense.evaluation.proof"): "a child process runs it, and imports it first",
    ("gpusense.reference.ranges", "gpusense.reference.{}"): "only the bodies of casters, which import no others",
}


def module_of(file: Path) -> str:
    """Return the dotted name of a file's module."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def docstrings(tree: ast.Module) -> set[int]:
    """Return the identities of docstring nodes and of unused strings."""
    return {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}


def pattern_of(node: ast.JoinedStr) -> str:
    """Return an f-string with ``{}`` instead of its values."""
    return "".join(str(one.value) if isinstance(one, ast.Constant) else "{}" for one in node.values)


def named(tree: ast.Module, package: str) -> Iterator[tuple[str, bool]]:
    """Yield dotted names that a module imports, and whether the last part may be a name in the module before it."""
    unused = docstrings(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, False) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield from ((f"{base}.{alias.name}", True) for alias in node.names)
        elif isinstance(node, ast.JoinedStr):
            yield pattern_of(node), False
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in unused:
            text = node.value.partition(":")[0]
            yield from [(text, False)] if "." in text else []


def imports_of(sources: Mapping[str, str], packages: Collection[str] = ()) -> Graph:
    """Return the modules that each module imports.

    Args:
        sources: Source of each module by its dotted name.
        packages: Names of packages among them.
    """
    graph: Graph = {}
    for name, source in sources.items():
        found: set[str] = set()
        for text, is_name in named(ast.parse(source), name if name in packages else name.rpartition(".")[0]):
            if (name, text) in NO_IMPORTS:
                continue
            if text in sources:
                found.add(text)
            elif is_name and text.rpartition(".")[0] in sources:
                found.add(text.rpartition(".")[0])
            elif "{}" in text and text.startswith(f"{PACKAGE}."):
                fits = re.compile(re.escape(text).replace(re.escape("{}"), r"\w+"))
                found |= {other for other in sources if fits.fullmatch(other)}
        graph[name] = found - {name}
    return graph


def circles(graph: Graph) -> list[set[str]]:
    """Return the sets of mutually reachable nodes."""
    reached: Graph = {}
    for start in graph:
        seen: set[str] = set()
        left = [start]
        while left:
            left += (new := graph.get(left.pop(), set()) - seen)
            seen |= new
        reached[start] = seen
    found = [{one for one in reached[node] if node in reached[one]} for node in graph if node in reached[node]]
    return [each for i, each in enumerate(found) if each not in found[:i]]


def rooms_of(graph: Graph) -> Graph:
    """Return the rooms that each room imports; a module outside the rooms counts as one."""
    rooms: Graph = {}
    for name, found in graph.items():
        room, others = name.split(".")[1], {other.split(".")[1] for other in found}
        rooms.setdefault(room, set()).update(others - {room})
    return rooms


@pytest.fixture(scope="module")
def graph() -> Graph:
    """Return the imports of the package's modules, except the root, which names all rooms."""
    files = {module_of(file): file for file in (ROOT / PACKAGE).rglob("*.py")}
    packages = [name for name, file in files.items() if file.name == "__init__.py"]
    found = imports_of({name: file.read_text(encoding="utf-8") for name, file in files.items()}, packages)
    del found[PACKAGE]
    return found


def test_no_module_imports_the_root(graph):
    """The root imports all rooms; the version is in ``_version``."""
    assert [name for name, found in graph.items() if PACKAGE in found] == []


def test_modules_form_no_circle(graph):
    assert circles(graph) == []


def test_rooms_form_no_circle(graph):
    assert circles(rooms_of(graph)) == []


def test_this_sees_the_imports_of_the_package(graph):
    """A graph that missed the imports would have no circle either."""
    assert len(graph) > 400 and sum(map(len, graph.values())) > 1500
    # At the top, in a function, in a table of modules.
    assert "gpusense.backends.base" in graph["gpusense.backends.opencl.backend"]
    assert "gpusense.world.map_files" in graph["gpusense.sweeps.store"]
    assert "gpusense.backends.opencl.library" in graph["gpusense.backends.registry"]
    assert "gpusense.logs.carmen" in graph["gpusense.logs.reader"]


@pytest.mark.parametrize("source", [
    "from gpusense.two.b import name",
    "import gpusense.two.b",
    "from ..two import b",
    "def late():\n    from gpusense.two.b import name",
    "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from gpusense.two import b",
    "import importlib\nimportlib.import_module('gpusense.two.b').name()",
    "import importlib\ndef late(name):\n    return importlib.import_module(f'gpusense.two.{name}')",
    "TABLE = {'x': 'gpusense.two.b:name'}",
])  # fmt: skip
def test_a_circle_is_found_wherever_its_import_stands(source):
    graph = imports_of({"gpusense.one.a": source, "gpusense.two.b": "from gpusense.one import a"})
    assert circles(graph) == [{"gpusense.one.a", "gpusense.two.b"}] and circles(rooms_of(graph)) == [{"one", "two"}]
    # A docstring is no import.
    graph = imports_of({"gpusense.one.a": source, "gpusense.two.b": "'gpusense.one.a'"})
    assert graph["gpusense.one.a"] == {"gpusense.two.b"} and circles(graph) == circles(rooms_of(graph)) == []
