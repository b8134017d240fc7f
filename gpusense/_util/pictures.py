"""Draw pictures of results: results name pictures, and the package's root registers drawing functions by name."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

Drawer = Callable[[Any, str | os.PathLike[str]], None]

_DRAWERS: dict[str, Drawer] = {}


def register(name: str, drawer: Drawer) -> None:
    """Register the function that draws a named picture and writes it to a path."""
    _DRAWERS[name] = drawer


def draw(name: str, result: Any, path: str | os.PathLike[str]) -> None:
    """Draw the named picture of a result, and write it to a path."""
    _DRAWERS[name](result, path)
