"""Types and files for bad input to the map, the scanner, the parameters and the logs.

Each case is (id, action, exception type, message). The action takes an empty folder and writes its input files to
``input`` in it, so everything outside ``input`` comes from the library. ``{tmp}`` in a message is the folder.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

Action = Callable[[Path], object]


def put(tmp: Path, name: str, content: bytes | str) -> Path:
    """Write one input file."""
    file = tmp / "input" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file
