"""Load outside candidates: other implementations, measured in the same run.

A Python file outside the package defines them: ``bench/speed/baselines.py`` of a checkout, or a file that the user
names. Its function ``candidates()`` returns ``Candidate`` objects (see ``candidates.py``) with ``outside`` set; their
``make`` is called with the scene, None and the candidate's precision.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from gpusense._util.checks import existing_file
from gpusense.evaluation.benchmark.candidates import PROBLEMS, Candidate

FILE = "bench/speed/baselines.py"
_MODULE = "gpusense_bench_peers"


def checkout() -> Path | None:
    """Return the checkout that this package is imported from; None for an installed package."""
    root = Path(__file__).resolve().parents[3]
    return root if (root / "pyproject.toml").is_file() and (root / "gpusense").is_dir() else None


def default_file() -> Path | None:
    """Return the checkout's file of outside candidates, or None."""
    root = checkout()
    file = None if root is None else root / FILE
    return file if file is not None and file.is_file() else None


def load(file: Path, problems: Sequence[str]) -> list[Candidate]:
    """Execute a file and return its candidates for some problems.

    Args:
        file: The Python file.
        problems: The problems, out of ``PROBLEMS``.

    Raises:
        OSError, ValueError: the file is missing, does not run, or has no ``candidates()`` that returns a list of
            outside candidates with known problems.
    """
    existing_file(file)
    spec = importlib.util.spec_from_file_location(_MODULE, file)
    if spec is None or spec.loader is None:
        raise ValueError(f"peers: must be a Python file, got {str(file)!r}")
    # Libraries that keep compiled code on disk look a function's module up by its name.
    module = sys.modules[_MODULE] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        candidates = list(module.candidates())
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"peers: {file} must run and have candidates(), got {reason}") from error
    for candidate in candidates:
        if not (isinstance(candidate, Candidate) and candidate.outside and candidate.problem in PROBLEMS):
            raise ValueError(f"peers: {file} must return Candidate objects with outside= set, got {candidate!r:.100}")
    return [candidate for candidate in candidates if candidate.problem in problems]
