"""Experiments with the exact caster's step in OpenCL: the same bits, other instructions. Nothing here is built in.

    python bench/try_raycast.py --backend opencl:0:0 --particles 100000

Variants of the loop's end: as built (a branch on the axis that steps), without that branch, and with boundaries counted
by rounding to nearest instead of up or down; each with work-groups of several shapes (beams x particles).
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any

import numpy as np
import pyopencl as cl

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.signatures import KERNELS
from gpusense.sources import assemble
from gpusense.worlds import building, cloud_around, cloud_uniform, free_pose

GROUPS = ((64, 1), (32, 1), (128, 1), (32, 4), (16, 8))
BEGIN, END = (
    "        t = t_x <= t_y ? t_x : t_y;\n",
    "            k_x = crossed_until(t, r.speed_x, r.a_x, r.inv_x);\n        }\n",
)
PICK = """\
        const int by_x = t_x <= t_y;
        t = by_x ? t_x : t_y;
        if (t >= limit) return limit;
        const real speed = by_x ? r.speed_y : r.speed_x, a = by_x ? r.a_y : r.a_x, inv = by_x ? r.inv_y : r.inv_x;
"""
CORRECT = """\
        const real here = ((real)guess + a) * inv, last = ((real)(guess - 1) + a) * inv;
        const int more = here < t || (!by_x && here == t);
        const int fewer = guess > 0 && !more && (last > t || (by_x && last == t));
        const int crossed = guess + more - fewer;
        k_x = by_x ? k_x + side : crossed;
        k_y = by_x ? crossed : k_y + side;
"""
UP_OR_DOWN = """\
        const real place = t * speed - a;
        const int whole = (int)place;
        const int guess = by_x ? max(whole + ((real)whole < place), 0) : whole - ((real)whole > place) + 1;
"""
NEAREST = "        const int guess = (int)fmax(rint(t * speed - a), (real)0);\n"


def variants() -> dict[str, str]:
    """Sources of cast_ranges by what is tried."""
    built = assemble("ranges", frozenset())
    first, last = built.index(BEGIN), built.index(END) + len(END)
    bodies = {"no branch": PICK + UP_OR_DOWN + CORRECT, "nearest": PICK + NEAREST + CORRECT}
    return {"as built": built} | {name: built[:first] + body + built[last:] for name, body in bodies.items()}


def captured(backend: Any, caster: gs.RayCaster, poses: np.ndarray, bearings: np.ndarray) -> tuple[Any, np.ndarray]:
    """The arguments of the caster's own launch, still on the device, and its ranges."""
    kept: list[Any] = []
    compile_kernel = backend.compile

    def watch(kernel: str, flags: frozenset[str]) -> Any:
        launcher = compile_kernel(kernel, flags)

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            launcher(size, *arguments)
            kept.append((size, arguments))

        return launch if kernel == "cast_ranges" else launcher

    backend.compile = watch
    try:
        ranges = caster.cast(poses, bearings)
    finally:
        backend.compile = compile_kernel
    return kept[-1], ranges


def main() -> None:
    """Print rates and differing bits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--beams", type=int, default=360)
    arguments = parser.parse_args()
    backend: Any = get_backend(arguments.backend)
    backend.info = dataclasses.replace(backend.info, lanes=1)
    print(backend.info.name, backend.info.driver)
    rng, grid = np.random.default_rng(0), building(0, (100.0, 100.0), resolution=0.05)
    pose, count = free_pose(grid, rng, 0.3), arguments.particles
    bearings = np.linspace(-np.pi, np.pi, arguments.beams, endpoint=False)
    real = np.dtype(np.float32)
    scalars = [a.dtype(real).type if a.shape is None else None for a in KERNELS["cast_ranges"].arguments]
    clouds = {"tracking": cloud_around(pose, count, 0.5, 0.25, rng), "global": cloud_uniform(grid, count, rng)}
    for cloud, poses in clouds.items():
        (size, given), right = captured(backend, gs.RayCaster(grid, 30.0, backend=backend), poses, bearings)
        for name, source in variants().items():
            kernel = cl.Kernel(cl.Program(backend._context, source).build(backend.options), "cast_ranges")
            kernel.set_args(
                *(value if kind is None else kind(value) for kind, value in zip(scalars, given, strict=True))
            )
            for group in GROUPS:
                rounded = tuple(-(-n // g) * g for n, g in zip(size, group, strict=True))
                times = []
                for _ in range(6):
                    begin = time.perf_counter()
                    cl.enqueue_nd_range_kernel(backend._queue, kernel, rounded, group)
                    backend._queue.finish()
                    times.append(time.perf_counter() - begin)
                found = backend.download(given[4], np.empty_like(right))
                rate, differ = right.size / min(times) / 1e6, int(np.count_nonzero(found != right))
                print(f"{cloud:8s} {name:10s} groups {group[0]:3d} x {group[1]}: {rate:9.1f} M rays/s, {differ} differ")


if __name__ == "__main__":
    main()
