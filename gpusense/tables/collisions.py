"""Collisions of discs with the obstacles and moving shapes of many worlds."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.base import Buffer
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import launch
from gpusense.interface.structs import Frame
from gpusense.tables.world_index import InWorlds, ManyWorlds, WorldIndex
from gpusense.world.windows import LONGEST_SIDE

_INT, _BYTE, _SINGLE = np.dtype(np.int32), np.dtype(np.uint8), np.dtype(np.float32)


def collisions(worlds: ManyWorlds, poses: Any, radius: object, world: Any, ignore: Any, unknown: str) -> Any:
    """Return which discs about poses meet an obstacle or a shape; see ``Worlds.collides``."""
    # A larger disc covers every world.
    cells = min(checks.real("radius", radius, low=0) / worlds.resolution, 4.0 * LONGEST_SIDE)
    checks.choice("unknown", unknown, ("free", "occupied"))
    backend, single, there = worlds.backend, False, arrays.on_device(poses)
    if there:
        buffer, count, single, _ = arrays.adopt_poses(poses, backend, "poses")
    else:
        host = checks.array("poses", arrays.host_poses(poses, "poses"), ("N", 3))
        buffer, count = backend.upload(host), len(host)
    inside = WorldIndex(worlds, world, ignore, count, backend).buffers(backend, worlds.space, (0, count))
    hit = backend.empty_external(count, _BYTE) if there else backend.empty(count, _BYTE)
    if count:
        _collide(worlds, buffer, count, inside, hit, cells, single=single, unknown=unknown == "occupied")
    if there:
        return arrays.wrapped(poses, backend, hit, (count,), _BYTE)
    return arrays.like(poses, backend.download(hit, np.empty(count, np.uint8)).view(bool))


def _collide(
    worlds: ManyWorlds, poses: Buffer, count: int, inside: InWorlds, hit: Buffer, radius: float, *, single: bool,
    unknown: bool,
) -> None:  # fmt: skip
    """Place poses, and find the discs about them, with a radius in cells, that meet anything."""
    space, backend = worlds.space, worlds.backend
    cell, pose = space.empty("cell", 2 * count, _INT), space.empty("pose", 4 * count, _SINGLE)
    placed, status = space.empty("placed", 4 * count, _INT), backend.upload(np.zeros(2, _INT))
    crowd = dict(shapes=worlds.crowd.table(_SINGLE), crowd=inside.crowd)
    flags = inside.flags | flags_if(POSES_FLOAT32=single, HUGE_HEADINGS=True)
    backend.run((
        launch(
            "place_in_worlds", flags, (count,), poses=poses, index=inside.index, ignore=inside.ignore,
            frames=worlds.frames, pose_cell=cell, pose=pose, pose_low=space.empty("low", 4, _SINGLE), world=placed,
            pose_status=status, frame=Frame(0.0, 0.0, worlds.resolution, 0.0, 0.0, 1.0, 0.0), particles=count,
            worlds=len(worlds), wide=inside.wide, wide_ignore=inside.wide_ignore, **crowd,
        ),
        launch(
            "find_collisions", inside.flags, (count,), store=worlds.store, world=placed, **crowd, pose_cell=cell,
            pose=pose, hit=hit, particles=count, radius=radius, threshold=worlds.threshold, unknown=int(unknown),
        ),
    ))  # fmt: skip
    state = backend.download(status, np.zeros(2, _INT))
    space.wait()
    if state[0] > 1:
        raise ValueError("world: every index must be one of the worlds, got an index on the device that is not")
    if state[0]:
        raise ValueError("poses: must be finite, got a pose on the device that is not")
