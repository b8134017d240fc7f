"""The layout of the tests: folders that mirror the package's, helpers in ``support``, fixtures in ``conftest.py``."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from support.paths import ROOT, TESTS

# Folders of tests that mirror no folder of the package.
OTHERS = {"kernels": "the kernels in all languages", "project": "packaging, scripts, documentation, layout"}
LONGEST = 450

FILES = sorted(TESTS.rglob("*.py"))
TEST_FILES = [path for path in FILES if path.name.startswith("test_")]
SUPPORT = [path for path in FILES if path.is_relative_to(TESTS / "support")]


def names_of(paths: list[Path]) -> list[str]:
    return [path.relative_to(TESTS).as_posix() for path in paths]


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield (module, name) of every import; the name is empty where a module is imported whole."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.module or ".", alias.name) for alias in node.names)


def fixtures(tree: ast.Module) -> list[str]:
    """Return the names of the fixtures that a file defines."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [one.name for one in functions if any("fixture" in ast.unparse(mark) for mark in one.decorator_list)]


def test_every_file_is_a_test_a_helper_or_a_conftest():
    known = {*TEST_FILES, *SUPPORT}
    assert names_of([path for path in FILES if path not in known and path.name != "conftest.py"]) == []
    assert not [path for path in SUPPORT if path.name.startswith("test_") or path.name == "conftest.py"]


def test_test_files_lie_in_rooms():
    """Rooms are the folders of the package that hold modules."""
    folders = {path.parent.relative_to(TESTS).as_posix() for path in TEST_FILES}
    rooms = {name for name in folders if (ROOT / "gpusense" / name / "__init__.py").is_file()}
    assert folders - rooms == OTHERS.keys()


def test_test_files_are_short():
    lines = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in TEST_FILES}
    assert {name: count for name, count in lines.items() if count > LONGEST} == {}


def test_no_file_imports_a_test_or_a_conftest():
    """Shared functions and scenes are in ``support``."""
    files = {path.stem for path in TEST_FILES} | {"conftest"}
    for path in FILES:
        if not re.search(r"\bimport\b[^\n]*\(|(import|from) .*(test_|conftest)", path.read_text(encoding="utf-8")):
            continue
        modules = {part for module, name in imported(tree_of(path)) for part in (*module.split("."), name)}
        assert modules & files == set(), path


def test_helpers_define_no_fixture():
    """A fixture is defined in a ``conftest.py``, or in the only test file that uses it."""
    assert {path.name: found for path in SUPPORT if (found := fixtures(tree_of(path)))} == {}


def test_this_looks_at_all_there_is():
    """The rules would also hold if no file, fixture or import was found."""
    assert len(TEST_FILES) > 100 and len(SUPPORT) > 20
    assert {"backend", "needs", "place"} <= set(fixtures(tree_of(TESTS / "conftest.py")))
    assert ("support.paths", "ROOT") in set(imported(tree_of(Path(__file__))))
    assert ("re", "") in set(imported(ast.parse("import re")))


def test_the_quick_subset_has_files_of_today():
    """A moved file must not silently leave the subset."""
    names = ast.literal_eval(re.search(r"^QUICK = (\(.*?^\))", (TESTS / "conftest.py").read_text(), re.M | re.S)[1])
    assert [name for name in names if not (TESTS / name).exists()] == []
