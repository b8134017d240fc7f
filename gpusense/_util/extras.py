"""Import optional libraries, with one-line errors that name the command to install them."""

from __future__ import annotations

import importlib
import importlib.util
import shlex
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple


class Requirement(NamedTuple):
    """Library that gpusense imports late."""

    package: str  # name of its package for pip
    extra: str = ""  # extra of gpusense that installs it; empty for a required dependency


# Keyed by the imported module; a test compares the packages with pyproject.toml.
REQUIREMENTS = {
    "PIL": Requirement("Pillow"),
    "dask": Requirement("dask[diagnostics,distributed]", "sweep"),
    "distributed": Requirement("dask[diagnostics,distributed]", "sweep"),
    "matplotlib": Requirement("matplotlib"),
    "numba": Requirement("numba", "bench"),
    "platformdirs": Requirement("platformdirs"),
    "pyarrow": Requirement("pyarrow", "sweep"),
    "pyopencl": Requirement("pyopencl"),
    "rerun": Requirement("rerun-sdk", "rerun"),
    "rich": Requirement("rich"),
    "rosbags": Requirement("rosbags"),
    "scipy": Requirement("scipy"),
    "warp": Requirement("warp-lang"),
    "yaml": Requirement("PyYAML"),
}


class MissingLibraryError(ImportError):
    """A library is absent or cannot be imported; the message is one line with the command that installs it."""


def library(module: str, purpose: str) -> ModuleType:
    """Import a module such as ``"pyarrow.parquet"`` for a purpose, or raise MissingLibraryError."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing(module, purpose, error) from error


def check_library(module: str, purpose: str) -> None:
    """Check that a library is installed, without importing it."""
    name = module.partition(".")[0]
    try:
        absent = importlib.util.find_spec(name) is None
    except ValueError:  # the module is None in sys.modules or has no spec
        absent = sys.modules.get(name) is None
    if absent:
        raise missing(name, purpose, ModuleNotFoundError(f"No module named {name!r}", name=name))


def missing(module: str, purpose: str, error: ImportError) -> MissingLibraryError:
    """Return the error for a library that cannot be imported."""
    name = module.partition(".")[0]
    package = REQUIREMENTS[name].package.partition("[")[0]
    absent = isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == name
    reason = "is not installed" if absent else f"cannot be imported ({' '.join(str(error).split())})"
    text = f"{purpose} needs the library {package}, which {reason}: {install_command(name)}"
    return MissingLibraryError(text, name=name)


def explained(error: ImportError) -> MissingLibraryError | None:
    """Return the one-line error for a library that gpusense uses; None for any other library."""
    if isinstance(error, MissingLibraryError):
        return error
    name = (error.name or "").partition(".")[0]
    return missing(name, "gpusense", error) if name in REQUIREMENTS else None


def install_command(module: str) -> str:
    """Return the command that installs a library for the running Python, with a variant for a checkout."""
    needed, pip = REQUIREMENTS[module.partition(".")[0]], _pip()
    command = f"{pip} install {shlex.quote(needed.package)}"
    return f"{command}, or in a checkout of gpusense {pip} install '.[{needed.extra}]'" if needed.extra else command


def _pip() -> str:
    """Return the command that runs this Python's pip: ``pip`` if the shell finds it."""
    pip = shutil.which("pip")
    folder = Path(sys.executable).parent if sys.executable else None
    if folder is None or (pip is not None and Path(pip).parent == folder):
        return "pip"
    return f"{shlex.quote(sys.executable)} -m pip"
