"""Every public name has a short example."""

import inspect

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
