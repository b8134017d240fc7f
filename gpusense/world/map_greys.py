"""Paint the cells of a map as the greys of map_server's modes."""

from __future__ import annotations

from typing import BinaryIO, Literal, NamedTuple

import numpy as np

from gpusense.world.grid import OccupancyGrid

MapMode = Literal["trinary", "scale", "raw"]
MODES = ("trinary", "scale", "raw")
# Greys that map_saver writes for free, occupied and unknown cells.
FREE_GREY, OCCUPIED_GREY, UNKNOWN_GREY = 254, 0, 205
_UNKNOWN = 255  # the byte of the cell -1


class Painting(NamedTuple):
    """Pixels of a map, topmost row first, and the keys of the YAML file for reading them."""

    mode: MapMode  # mode of map_server
    pixels: bytes  # a grey for each cell; with ``alpha``, each followed by its opacity
    alpha: bool  # true if unknown cells are transparent
    occupied_thresh: float  # least darkness of an occupied cell
    free_thresh: float  # largest darkness of a free cell


def paint(grid: OccupancyGrid, mode: MapMode | None) -> Painting:
    """Paint a map in a mode; None chooses a lossless one: trinary for a map of 0, 100 and unknown, else raw."""
    cells = grid.cells
    if mode is None:
        plain = sum(np.count_nonzero(cells == value) for value in (0, 100, -1)) == cells.size
        mode = "trinary" if plain else "raw"
    values = np.arange(101)
    greys = np.full(256, _UNKNOWN, np.uint8)  # by the cell's byte
    if mode == "trinary":
        greys[:101] = np.where(values >= grid.occupied_threshold, OCCUPIED_GREY, FREE_GREY)
        greys[_UNKNOWN] = UNKNOWN_GREY
    elif mode == "scale":
        greys[:101] = np.rint(255 * (1 - values / 100))
        greys[_UNKNOWN] = UNKNOWN_GREY
    else:
        greys[:101] = values
    pixels = cells[::-1].tobytes().translate(greys.tobytes())
    limits = (1.0, 0.0) if mode == "scale" else (0.65, 0.196)
    alpha = mode == "scale" and bool(grid.unknown.any())
    if alpha:
        both = np.empty((cells.size, 2), np.uint8)
        both[:, 0] = np.frombuffer(pixels, np.uint8)
        both[:, 1] = np.where(cells[::-1].ravel() < 0, 0, 255)
        pixels = both.tobytes()
    return Painting(mode, pixels, alpha, *limits)


def write_image(stream: BinaryIO, painting: Painting, shape: tuple[int, int], image_format: str) -> None:
    """Write a painting as a PGM or PNG image; transparent cells need PNG."""
    size = shape[::-1]
    if image_format == "png":
        from PIL import Image

        Image.frombytes("LA" if painting.alpha else "L", size, painting.pixels).save(stream, "PNG")
    else:
        stream.write(b"P5\n%d %d\n255\n" % size)
        stream.write(painting.pixels)
