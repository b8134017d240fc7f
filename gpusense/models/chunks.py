"""Large calls in pieces that fit into a device's memory, and that a processor ends within seconds."""

from __future__ import annotations

from collections.abc import Callable

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.tables.reachable import TableMemoryError

# Particles of one launch: enough to fill a device, few enough for its memory (44 bytes each).
CHUNK = 1 << 20
# Most bytes of a result with a number per particle and beam.
CHUNK_BYTES = 320 << 20
# Most particle-beams of one launch on a processor: it can be interrupted between launches, a few seconds apart.
CHUNK_WORK = 1 << 24
# A launch that does not fit is tried with half the particles down to this.
SMALLEST_CHUNK = 256
# Chunks are multiples of so many particles, unless they are smaller: every device can begin at their numbers.
_ROUND = 256


def chunk_of(backend: Backend, beams: int, itemsize: float = 0) -> int:
    """Particles of one launch of so many beams, with a result of ``itemsize`` bytes per particle-beam."""
    chunk = CHUNK
    if itemsize:
        chunk = min(chunk, int(CHUNK_BYTES // (beams * itemsize)))
    if backend.info.kind == "cpu":
        chunk = min(chunk, CHUNK_WORK // beams)
    return _rounded(max(chunk, 1))


def _rounded(chunk: int) -> int:
    return chunk - chunk % _ROUND if chunk > _ROUND else chunk


def in_chunks(count: int, chunk: int, workspace: Workspace, run: Callable[[int, int], None]) -> None:
    """Call ``run(begin, end)`` over [0, count) in pieces; pieces that do not fit into memory are halved.

    Raises:
        MemoryError: not even the smallest piece fits, or not the map's table, which is tried only once. The model still
            works for smaller calls.
    """
    begin = 0
    while begin < count:
        try:
            run(begin, min(begin + chunk, count))
            begin += chunk
        except TableMemoryError:
            workspace.release()
            raise
        except MemoryError:
            tried = min(chunk, count - begin)
            if tried <= SMALLEST_CHUNK:
                workspace.release()
                raise
            # What is known of the poses of earlier pieces stays.
            workspace.release(keep="verdict")
            chunk = max(_rounded(tried // 2), SMALLEST_CHUNK)
