"""Read the history of the checkout: whether it is whole, and how many commits are between one and the last."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def git(*words: str, root: Path = ROOT) -> str:
    """Return the output of git."""
    command = ["git", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def has_history(root: Path = ROOT) -> bool:
    """Return whether the folder is a checkout with its whole history."""
    try:
        own = Path(git("rev-parse", "--show-toplevel", root=root)).resolve() == root.resolve()
        return own and git("rev-parse", "--is-shallow-repository", root=root) == "false"
    except (OSError, subprocess.SubprocessError):
        return False


def commits_since(commit: str, folders: Sequence[str], *, root: Path = ROOT, ancestor: bool = False) -> float:
    """Count the commits to folders that the last commit has and another one lacks.

    Args:
        commit: The other commit.
        folders: Paths in the checkout.
        root: The checkout, with its history.
        ancestor: Whether a commit from which the last one does not descend counts as unknown.

    Returns:
        The number of commits; infinite where the clone lacks the commit.
    """
    return _counted(commit, tuple(folders), root, ancestor)


@cache
def _counted(commit: str, folders: tuple[str, ...], root: Path, ancestor: bool) -> float:
    try:
        if ancestor:
            git("merge-base", "--is-ancestor", commit, "HEAD", root=root)
        return int(git("rev-list", "--count", f"{commit}..HEAD", "--", *folders, root=root))
    except subprocess.CalledProcessError:
        return math.inf
