"""Pieces of a request that fit a device's memory, and that a processor completes within seconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import POSE_STATUS, Workspace
from gpusense.tables.reachable import TableMemoryError

# Largest number of particles of a launch: they fill a device and fit its memory (44 bytes each).
CHUNK = 1 << 20
# Largest size of a result with a number per particle and beam [bytes]; on a GPU a share of its memory, if that is more.
# The more particles are ordered together, the more cache lines they share.
CHUNK_BYTES, CHUNK_SHARE = 320 << 20, 32
# Largest number of particle-beams of a launch on a processor: a call can be interrupted between launches, every few
# seconds.
CHUNK_WORK = 1 << 24
# Smallest number of particles of a piece that is retried after a piece that did not fit.
SMALLEST_CHUNK = 256
# Larger pieces are multiples of this number of particles, so that every device can address their parts of buffers.
_ROUND = 256


def chunk_of(backend: Backend, beams: int, itemsize: float = 0) -> int:
    """Return the largest number of particles of a launch (``beams``: beams of each particle; 0 counts as 1)."""
    chunk, beams = CHUNK, max(beams, 1)
    if itemsize:
        info = backend.info
        largest = max(CHUNK_BYTES, info.memory // CHUNK_SHARE) if info.kind == "gpu" else CHUNK_BYTES
        chunk = min(chunk, int(largest // (beams * itemsize)))
    if backend.info.kind == "cpu":
        chunk = min(chunk, CHUNK_WORK // beams)
    chunk = max(chunk, 1)
    return chunk - chunk % _ROUND if chunk > _ROUND else chunk


class Piece:
    """Particles ``begin`` to ``end`` - 1 that one program scores, among the S N particles of S scans; ``per_scan``: N.

    ``part``: (begin, end); ``scans``: the first scan and the one after the last.
    """

    __slots__ = ("begin", "count", "end", "part", "per_scan", "scans")

    def __init__(self, begin: int, end: int, per_scan: int) -> None:
        self.begin, self.end, self.per_scan = begin, end, per_scan
        self.count, self.part = end - begin, (begin, end)
        self.scans = (begin // per_scan, -(-end // per_scan)) if per_scan else (0, 0)


def run_pieces(space: Workspace, whole: Piece, most: int, score: Callable[[Piece], None]) -> None:
    """Score particles in pieces of at most ``most``, whole scans where there are several; halve pieces that do not fit.

    Raises:
        MemoryError: The smallest piece does not fit, or the map's table (tried once); smaller calls still work.
    """
    begin, piece = whole.begin, whole
    while begin < whole.end:
        if begin or piece.count > most:
            piece = Piece(begin, _end(begin, whole.end, whole.per_scan, most), whole.per_scan)
        try:
            score(piece)
            begin = piece.end
        except TableMemoryError:
            space.release()
            raise
        except MemoryError:
            most = _halved(piece)
            # Keep the non-finite flag of earlier pieces.
            space.release(keep=POSE_STATUS[0] if most else "")
            if not most:
                raise


def _end(begin: int, end: int, per_scan: int, most: int) -> int:
    """Return the end of the piece that begins at a particle: whole scans, or a part of one."""
    if begin % per_scan == 0 and most >= per_scan:
        return min(begin + most // per_scan * per_scan, end)
    return min(begin + most, (begin // per_scan + 1) * per_scan)


def _halved(piece: Piece) -> int:
    """Return the number of particles of the next try; 0 without one."""
    if piece.count > piece.per_scan:
        return max(piece.count // 2, piece.per_scan)
    return 0 if piece.count <= SMALLEST_CHUNK else max(piece.count // 2 // _ROUND * _ROUND, SMALLEST_CHUNK)


def finish(space: Workspace, on_device: bool, name: str = "poses") -> None:
    """Wait for a call to end."""
    flag, dtype = POSE_STATUS
    if not on_device:
        space.wait()
    elif space.backend.in_batch:
        finish_all([(space, True)], name)
    else:
        # A copy that blocks is the only wait.
        state = np.zeros(2, dtype)
        space.read(space.empty(flag, 2, dtype, zero=True), state)
        _refuse([space], [state], name)


def finish_all(spaces: Sequence[tuple[Workspace, bool]], name: str = "poses") -> None:
    """Wait for a call to end; ``spaces``: its workspaces, each with whether it had device poses."""
    flag, dtype = POSE_STATUS
    states = [np.zeros(2, dtype) for _ in spaces]
    for (space, on_device), state in zip(spaces, states, strict=True):
        if on_device:
            space.download(space.empty(flag, 2, dtype, zero=True), state)
    for space, _ in spaces:
        # The first wait already covers all work on the device.
        space.wait()
    _refuse([space for space, _ in spaces], states, name)


def _refuse(spaces: Sequence[Workspace], states: Sequence[np.ndarray], name: str) -> None:
    """Raise the error of device poses by the non-finite flags of workspaces, and clear these."""
    flag, dtype = POSE_STATUS
    bad = [space for space, state in zip(spaces, states, strict=True) if state[0]]
    no_world = any(state[0] > 1 for state in states)
    for space in bad:
        space.upload(flag, np.zeros(2, dtype))
        space.wait()
    if no_world:
        raise ValueError("world: every index must be one of the worlds, got an index on the device that is not")
    if bad:
        raise ValueError(f"{name}: must be finite, got a pose on the device that is not")
