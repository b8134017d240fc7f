"""The stub of the package, made from its table of public names: ``PYTHONPATH=tests python -m support.public_names``."""

from __future__ import annotations

from support.paths import ROOT

import gpusense as gs

STUB = ROOT / "gpusense" / "__init__.pyi"
_HEAD = '''"""The types of the public names; support.public_names of the tests writes this file."""

'''


def stub() -> str:
    """Return the text of the stub: an import of every public module and name."""
    lines = [f"from gpusense import {name} as {name}" for name in sorted(gs._MODULES)]
    modules = {"_version": ("__version__",), **gs._NAMES}
    for module in sorted(modules):
        lines += [f"from gpusense.{module} import {name} as {name}" for name in sorted(modules[module])]
    return _HEAD + "\n".join(lines) + "\n"


def classes_of(base: type) -> set[type]:
    """Return the public classes that inherit from ``base``."""
    values = (getattr(gs, name) for name in gs.__all__)
    return {value for value in values if isinstance(value, type) and issubclass(value, base)}


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
