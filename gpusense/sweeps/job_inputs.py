"""Maps and logs that a sweep sends once to each worker on another machine."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense.sweeps.job import Job

# Largest log that is sent [bytes]; larger logs need a shared file system.
LARGEST = 1 << 30


def contents_of(jobs: Iterable[Job], root: str | Path) -> dict[str, Any]:
    """Read the maps and the bytes of the logs of jobs, by the paths that the jobs name.

    Args:
        jobs: The jobs.
        root: Folder of their files.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a map breaks its format, or a log is a folder or too large.
    """
    from gpusense.world.map_files import read_map

    folder, contents = Path(root), dict[str, Any]()
    for job in jobs:
        if job.map and job.map not in contents:
            contents[job.map] = read_map(folder / job.map)
        if job.log and job.log not in contents:
            file = folder / job.log
            if file.is_dir():
                raise ValueError(f"log: must be a file to be sent, got the folder {file}: share it, and use --no-send")
            size = checks.existing_file(file).stat().st_size
            if size > LARGEST:
                raise ValueError(f"log: must have at most {LARGEST} bytes to be sent, got {size} of {file}")
            contents[job.log] = file.read_bytes()
    return contents
