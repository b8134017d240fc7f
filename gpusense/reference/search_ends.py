"""End points of scans at all headings, as cells of tables of scores; see ``search``."""

from __future__ import annotations

import numpy as np

# Most points of a run.
_MOST = 64


def place_ends(
    flags: frozenset[str], end: np.ndarray, heading: np.ndarray, start: np.ndarray, first: np.ndarray,
    image: np.ndarray, point: np.ndarray, run: np.ndarray, run_image: np.ndarray, weight: np.ndarray,
    runs: np.ndarray, items: int, turns: int, period: int, step: int, offset: int,
) -> None:  # fmt: skip
    """Place the end points of scans at headings: cells of points, and runs of the same cell of a folded table."""
    side = period // step
    for scan in range(items // turns):
        begin, last = int(first[scan * turns]), int(first[(scan + 1) * turns])
        count = (last - begin) // turns
        if count == 0:
            runs[scan * turns : (scan + 1) * turns] = 0
            continue
        x, y = end[2 * (begin // turns) : 2 * (begin // turns + count)].reshape(count, 2).T
        cos, sin = heading[2 * scan * turns : 2 * (scan + 1) * turns].reshape(turns, 2, 1).swapaxes(0, 1)
        start_x, start_y = start[2 * scan : 2 * scan + 2]
        places = np.stack([start_x + (cos * x - sin * y), start_y + (sin * x + cos * y)], axis=-1)
        cells = np.floor(places).astype(np.int32)
        point[begin:last] = cells.reshape(-1, 2)
        folded = (cells + offset) // period
        phase = (cells + offset - folded * period) // step
        chosen = (image[begin:last].reshape(turns, count) * side + phase[..., 1]) * side + phase[..., 0]
        new = np.arange(count) % _MOST == 0
        new = new | np.pad(
            (np.diff(folded, axis=1) != 0).any(axis=2) | (np.diff(chosen, axis=1) != 0), ((0, 0), (1, 0)),
            constant_values=True,
        )  # fmt: skip
        made = new.sum(axis=1)
        runs[scan * turns : (scan + 1) * turns] = made
        turn, k = np.nonzero(new)
        target = begin + count * turn + np.arange(len(k)) - np.repeat(np.cumsum(made) - made, made)
        ends = np.append(k[1:], count)
        ends[np.cumsum(made) - 1] = count
        run[target], run_image[target], weight[target] = folded[turn, k], chosen[turn, k], ends - k
