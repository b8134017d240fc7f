"""Public names are listed once and have a short example that runs; public methods have or inherit a docstring."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path

import pytest
from support import public_names
from support.paths import ROOT

import gpusense as gs

FOLDER = Path(gs.__file__).parent


def modules_with_examples() -> list[str]:
    """Return the names of the package's modules with an example."""
    files = [path.relative_to(FOLDER.parent) for path in FOLDER.rglob("*.py") if ">>> " in path.read_text("utf-8")]
    return sorted(".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in files)


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # Examples write files.
    attempted = 0
    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(name), globs={}):
        report: list[str] = []
        result = doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE).run(
            test, out=report.append
        )
        assert result.failed == 0, "".join(report)
        attempted += result.attempted
    assert attempted > 0


def public_functions() -> dict[str, Callable[..., object]]:
    """Return the functions of gs and of its public modules by name."""
    spaces = {"": gs} | {name: getattr(gs, name) for name in ("plots", "worlds", "sweep", "compat")}
    return {
        f"{prefix}.{name}".lstrip("."): one
        for prefix, space in spaces.items()
        for name in space.__all__
        if inspect.isfunction(one := getattr(space, name))
    }


def test_public_functions_describe_their_arguments():
    functions = public_functions()
    assert len(functions) > 60 and "plots.save" in functions and "locate_scan" in functions
    taking = {name: one for name, one in functions.items() if inspect.signature(one).parameters}
    assert [name for name, one in taking.items() if "Args:" not in (one.__doc__ or "")] == []


def test_the_stub_is_that_of_the_table():
    text = public_names.STUB.read_text(encoding="utf-8")
    assert text == public_names.stub(), "run PYTHONPATH=tests python -m support.public_names"


def test_every_name_is_listed_once_and_completes():
    assert len(gs.__all__) == len(set(gs.__all__)) == 1 + sum(map(len, gs._NAMES.values()))
    assert {*gs.__all__, *gs._MODULES} == set(dir(gs))


@pytest.mark.parametrize("name", dir(gs))
def test_every_name_is_there(name):
    assert getattr(gs, name) is getattr(gs, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'gpusense' has no attribute 'BeamModle'"):
        gs.BeamModle  # noqa: B018


NAMES = [name for name in gs.__all__ if name != "__version__"]
# Names without an example yet.
PENDING: set[str] = set()


def test_pending_names_are_public() -> None:
    assert set(NAMES) >= PENDING


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_has_a_short_example(name: str) -> None:
    text = inspect.getdoc(getattr(gs, name)) or ""
    if name in PENDING and ">>>" not in text:
        pytest.skip("its example is still to be written")
    assert "\nExample:\n" in text, f"{name} has no section Example"
    lines = text.split("\nExample:\n")[1].splitlines()
    assert lines[0].strip().startswith(">>> import gpusense as gs")
    assert 2 <= sum(line.strip().startswith((">>>", "...")) for line in lines) <= 6


def test_pages_name_every_model() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    assert [name for name in NAMES if name.endswith("Model") and name not in pages] == []


def test_public_methods_have_or_inherit_a_docstring() -> None:
    classes = [
        node
        for file in Path(gs.__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    ]

    def bases_of(node: ast.ClassDef) -> set[str]:
        named = [base.value if isinstance(base, ast.Subscript) else base for base in node.bases]
        return {base.attr if isinstance(base, ast.Attribute) else base.id for base in named}  # type: ignore[attr-defined]

    documented = {
        (node.name, method.name)
        for node in classes
        for method in node.body
        if isinstance(method, ast.FunctionDef) and ast.get_docstring(method)
    }
    assert ("Backend", "upload") in documented and ("WarpBackend", "upload") not in documented

    def has_docstring(names: set[str], method: str) -> bool:
        if any((name, method) in documented for name in names):
            return True
        above = set().union(*(bases_of(node) for node in classes if node.name in names))
        return bool(above) and has_docstring(above, method)

    missing = [
        f"{node.name}.{method.name}"
        for node in classes
        if not node.name.startswith("_")
        for method in node.body
        if isinstance(method, ast.FunctionDef) and not method.name.startswith("_")
        and not any(ast.unparse(one).endswith(("overload", "setter")) for one in method.decorator_list)
        and not has_docstring({node.name}, method.name)
    ]  # fmt: skip
    assert not missing
