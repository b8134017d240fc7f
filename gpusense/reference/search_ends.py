"""End points of scans at all headings, as cells of tables of scores; see ``search``."""

import numpy as np


def place_ends(
    flags, end, heading, start, first, image, point, folded, bound_image, quarter_image, items, turns, stride, level,
    step_level, offset, workers,
    size, bound_size, quarter_size,
):  # fmt: skip
    """Place the end points of scans at headings in cells of the tables, and in cells and images of folded tables."""
    period, side = stride << level, stride << (level - step_level)
    for scan in range(items // turns):
        at, last = int(first[scan * turns]), int(first[(scan + 1) * turns])
        count = (last - at) // turns
        x, y = end[2 * (at // turns) : 2 * (at // turns + count)].reshape(count, 2).T
        cos, sin = heading[2 * scan * turns : 2 * (scan + 1) * turns].reshape(turns, 2, 1).swapaxes(0, 1)
        start_x, start_y = start[2 * scan : 2 * scan + 2]
        places = np.stack([start_x + (cos * x - sin * y), start_y + (sin * x + cos * y)], axis=-1)
        cells = np.floor(places).astype(np.int32).reshape(-1, 2)
        point[at:last] = cells
        folded[at:last] = (cells + offset) // period
        phase = cells + offset - folded[at:last] * period
        for images, count, cells, (col, row) in (
            (bound_image, side, bound_size, (phase >> step_level).T), (quarter_image, period, quarter_size, phase.T)
        ):  # fmt: skip
            images[at:last] = cells * ((image[at:last] * count + row) * count + col)
        image[at:last] *= size
