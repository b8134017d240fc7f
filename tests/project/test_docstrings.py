"""Every public name has an example, and the examples of docstrings run."""

import doctest
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

import gpusense as gs

NAMES = [name for name in gs.__all__ if name != "__version__"]
# Names without an example yet.
PENDING: set[str] = set()


def examples_of(name: str) -> Iterator[doctest.DocTest]:
    """Yield the examples of a public name and of its members, with an empty namespace each."""
    for test in doctest.DocTestFinder().find(getattr(gs, name), name, globs={}):
        if test.examples:
            yield test


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


@pytest.mark.parametrize("name", NAMES)
def test_the_examples_of_a_public_name_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # examples write files
    for test in examples_of(name):
        report: list[str] = []
        result = doctest.DocTestRunner(verbose=False).run(test, out=report.append)
        assert result.failed == 0, "".join(report)
