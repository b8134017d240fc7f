"""Other programs that follow a robot by its scans, for ``chaining.py``: KISS-ICP where it is installed, and CSM.

CSM (Censi 2008) is compiled from a copy of its sources that the user provides.
"""

from __future__ import annotations

import itertools
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs

CODE = Path(__file__).resolve().parent / "peer_code" / "csm.c"
VOXELS = (0.1, 0.3, 1.0)
# Files of CSM that draw, need other libraries, or are programs.
_LEFT_OUT = ("test", "cairo", "drawing", "mbicp", "_load")
_CONFIGURATION = "#define STDC_HEADERS 1\n" + "\n".join(
    f"#define HAVE_{name} 1"
    for name in ("STDARG_H", "STRNCASECMP", "STRNDUP", "STRDUP", "VPRINTF", "VSNPRINTF", "VASPRINTF", "FCNTL_H",
                 "LIMITS_H", "SYS_TYPES_H", "SYS_STAT_H", "UNISTD_H", "STDLIB_H", "STRING_H", "OPEN")
)  # fmt: skip


def build(source: Path, gsl: Path | None, folder: Path, *, shared: bool = False) -> Path:
    """Compile ``peer_code/csm.c`` and return the program, or with ``shared`` a library of its functions.

    ``gsl``: The folder of GSL's ``include`` and ``lib``; None if the compiler finds them.
    """
    root, program = source / "sm", folder / ("csm.so" if shared else "csm")
    files = [path for part in ("csm", "lib") for path in sorted((root / part).rglob("*.c"))]
    files = [path for path in files if not any(word in path.as_posix().split("/sm/")[-1] for word in _LEFT_OUT)]
    (folder / "config.h").write_text(_CONFIGURATION)
    places = [folder, root / "lib", root, *([gsl / "include"] if gsl else [])]
    libraries = [] if gsl is None else [f"-L{path.parent}" for path in sorted(gsl.rglob("libgsl.so"))]
    paths = [f"-Wl,--disable-new-dtags,-rpath,{place[2:]}" for place in libraries]
    subprocess.run(
        ["gcc", "-O2", "-DNDEBUG", "-std=gnu99", "-w", "-fcommon", *(["-fPIC", "-shared"] if shared else []),
         *(f"-I{place}" for place in places), "-o",
         str(program), str(CODE), *map(str, files), *libraries, *paths, "-lgsl", "-lgslcblas", "-lm"],
        check=True,
    )  # fmt: skip
    return program


def steps(program: Path, ranges: np.ndarray, scanner: gs.Scanner, guess: np.ndarray, folder: Path) -> np.ndarray:
    """Match each scan to the one before, and return the motions of the robot (S - 1, 3); guesses where CSM fails.

    ``ranges``: (S, K) readings [m]. ``guess``: (S - 1, 3) motions of the robot.
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


def csm_steps(
    source: Path, gsl: Path | None, ranges: np.ndarray, scanner: gs.Scanner, guess: np.ndarray
) -> tuple[np.ndarray, float]:
    """Compile CSM, and return the motions (S - 1, 3) from scan to scan and the time [s]."""
    with tempfile.TemporaryDirectory() as name:
        program = build(source, gsl, Path(name))
        begun = time.perf_counter()
        moved = steps(program, ranges, scanner, guess, Path(name))
        return moved, time.perf_counter() - begun


def kiss_icp(log: Any) -> list[tuple[np.ndarray, float, float]]:
    """Return poses of KISS-ICP with several options, its times and voxels; empty if it is not installed."""
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        return []
    results = []
    bearings = log.scanner.bearings + log.scanner.mount[2]
    share = np.linspace(0, 1, log.scanner.count)
    for voxel, deskew in itertools.product(VOXELS, (True, False) if log.duration else (False,)):
        config = KISSConfig()
        config.data.max_range, config.data.min_range = min(log.scanner.range_max, 50.0), 0.1
        config.data.deskew, config.mapping.voxel_size = deskew, voxel
        odometry, poses, begun = KissICP(config), [], time.perf_counter()
        for z in log.ranges:
            hit = np.isfinite(z) & (z > log.scanner.range_min) & (z < log.scanner.range_max)
            points = np.stack([z * np.cos(bearings), z * np.sin(bearings), 0 * z], axis=1)[hit]
            odometry.register_frame(points + np.array([*log.scanner.mount[:2], 0.0]), share[hit])
            pose = odometry.last_pose
            poses.append((pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])))
        seconds = time.perf_counter() - begun
        results.append((np.array(poses), seconds, voxel))
    return results
