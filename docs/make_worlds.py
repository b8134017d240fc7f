"""Make the animation of docs/worlds.md: python docs/make_worlds.py.

Eight of many rooms are drawn, with the rays of a robot in each and discs that move through them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import gpusense as gs

TARGET = Path(__file__).parent / "img" / "worlds.gif"
SIDE, SCALE, RESOLUTION, RANGE_MAX, FRAMES = 64, 2, 0.1, 5.0, 32
COLUMNS, ROWS, DISCS = 4, 2, 3
FREE, WALL, RAY, DISC, ROBOT = range(5)
PALETTE = (250, 250, 248, 60, 66, 76, 140, 190, 226, 226, 126, 60, 24, 96, 168)


def rooms(random: np.random.Generator, count: int) -> np.ndarray:
    """Return cells of rooms with two blocks in each."""
    cells = np.zeros((count, SIDE, SIDE), np.int8)
    cells[:, [0, -1]] = cells[:, :, [0, -1]] = 100
    for room in cells:
        for row, col in random.integers(6, SIDE - 20, (2, 2)):
            room[row : row + 12, col : col + 8] = 100
        room[26:38, 26:38] = 0
    return cells


def main() -> None:
    """Cast the rays of all frames, draw them and write the animation."""
    random, count = np.random.default_rng(4), COLUMNS * ROWS
    cells = rooms(random, count)
    worlds = gs.Worlds(cells, RESOLUTION, backend="numpy")
    caster, bearings = gs.RayCaster(worlds, RANGE_MAX, backend="numpy"), np.linspace(-np.pi, np.pi, 48, endpoint=False)
    phase, frames = random.uniform(0, 2 * np.pi, (count, DISCS, 2)), []
    for frame in range(FRAMES):
        turn, middle = 2 * np.pi * frame / FRAMES, SIDE * RESOLUTION / 2
        discs = np.concatenate([middle + 2.5 * np.sin(phase + turn), np.full((count, DISCS, 1), 0.25)], axis=2)
        worlds.shapes = gs.Shapes(discs=discs)
        poses = np.column_stack([middle + 0.5 * np.cos(turn + np.arange(count)),
                                 middle + 0.5 * np.sin(turn + np.arange(count)), np.full(count, turn)])  # fmt: skip
        ranges = caster.cast(poses, bearings, world=np.arange(count))
        tile = SIDE * SCALE + 4
        picture = Image.new("P", (COLUMNS * tile, ROWS * tile), FREE)
        picture.putpalette(PALETTE)
        draw, pixels = ImageDraw.Draw(picture), SCALE / RESOLUTION
        for world in range(count):
            left, top = world % COLUMNS * tile, world // COLUMNS * tile
            x, y = left + poses[world, 0] * pixels, top + poses[world, 1] * pixels
            for bearing, away in zip(bearings + poses[world, 2], ranges[world], strict=True):
                draw.line((x, y, x + away * pixels * np.cos(bearing), y + away * pixels * np.sin(bearing)), RAY)
            for row, col in np.argwhere(cells[world] > 0):
                corner = left + col * SCALE, top + row * SCALE
                draw.rectangle((*corner, corner[0] + SCALE - 1, corner[1] + SCALE - 1), WALL)
            for a, b, radius in discs[world] * pixels:
                draw.ellipse((left + a - radius, top + b - radius, left + a + radius, top + b + radius), DISC)
            draw.ellipse((x - 3, y - 3, x + 3, y + 3), ROBOT)
        frames.append(picture)
    frames[0].save(TARGET, save_all=True, append_images=frames[1:], duration=80, loop=0, optimize=True)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
