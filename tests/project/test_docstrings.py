"""Every public name has a short example, and every public method a docstring, possibly inherited."""

import ast
import inspect
from pathlib import Path

import pytest

import gpusense as gs

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
