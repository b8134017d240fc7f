"""CSM (Censi 2008) as compiled from a copy of its sources, which the user gives; for ``chaining.py``."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np

import gpusense as gs

CODE = Path(__file__).resolve().parent / "peer_code" / "csm.c"
# Parts that draw, that need other libraries, or that are programs.
_LEFT_OUT = ("test", "cairo", "drawing", "mbicp", "_load")
_CONFIGURATION = "#define STDC_HEADERS 1\n" + "\n".join(
    f"#define HAVE_{name} 1"
    for name in ("STDARG_H", "STRNCASECMP", "STRNDUP", "STRDUP", "VPRINTF", "VSNPRINTF", "VASPRINTF", "FCNTL_H",
                 "LIMITS_H", "SYS_TYPES_H", "SYS_STAT_H", "UNISTD_H", "STDLIB_H", "STRING_H", "OPEN")
)  # fmt: skip


def build(source: Path, gsl: Path | None, folder: Path) -> Path:
    """Compile the program of ``peer_code/csm.c``, and return it.

    Args:
        source: A copy of CSM's repository.
        gsl: Where GSL's ``include`` and ``lib`` are; None where the compiler finds them.
        folder: Place of the program.
    """
    root, program = source / "sm", folder / "csm"
    files = [path for part in ("csm", "lib") for path in sorted((root / part).rglob("*.c"))]
    files = [path for path in files if not any(word in path.as_posix().split("/sm/")[-1] for word in _LEFT_OUT)]
    (folder / "config.h").write_text(_CONFIGURATION)
    places = [folder, root / "lib", root, *([gsl / "include"] if gsl else [])]
    libraries = [] if gsl is None else [f"-L{path.parent}" for path in sorted(gsl.rglob("libgsl.so"))]
    paths = [f"-Wl,--disable-new-dtags,-rpath,{place[2:]}" for place in libraries]
    subprocess.run(
        ["gcc", "-O2", "-DNDEBUG", "-std=gnu99", "-w", "-fcommon", *(f"-I{place}" for place in places), "-o",
         str(program), str(CODE), *map(str, files), *libraries, *paths, "-lgsl", "-lgslcblas", "-lm"],
        check=True,
    )  # fmt: skip
    return program


def steps(program: Path, ranges: np.ndarray, scanner: gs.Scanner, guess: np.ndarray, folder: Path) -> np.ndarray:
    """Match each scan to the one before, and return the motions of the robot (S - 1, 3); guesses where CSM fails.

    Args:
        program: From ``build``.
        ranges: (S, K) readings [m].
        scanner: Their scanner.
        guess: (S - 1, 3) motions of the robot.
        folder: A folder for its files.
    """
    mount = np.array(scanner.mount)
    order = np.argsort(scanner.bearings)
    hit = (ranges > max(scanner.range_min, 0.01)) & (ranges < scanner.range_max)
    seen = gs.compose_poses(gs.invert_poses(mount), gs.compose_poses(guess, mount))
    parts = ([ranges.shape[1], len(ranges)], scanner.bearings[order], np.where(hit, ranges, np.nan)[:, order], seen)
    (folder / "in").write_bytes(b"".join(np.asarray(part, np.float64).tobytes() for part in parts))
    subprocess.run([program, folder / "in", folder / "out"], check=True, stderr=subprocess.DEVNULL)
    found = np.fromfile(folder / "out").reshape(-1, 4)
    usable = (found[:, 0] > 0) & np.isfinite(found).all(axis=1)
    moved = gs.compose_poses(
        mount, gs.compose_poses(np.where(usable[:, None], found[:, 1:], 0), gs.invert_poses(mount))
    )
    return np.where(usable[:, None], moved, guess)
