"""Maps have the bits of nav2_map_server 1.5.1: checked by rational arithmetic, and by digests of its libraries' output.

The digests are those of GraphicsMagick 1.3.40 (16 bits) and Eigen 3.4.0 for the calls in nav2's ``map_io.cpp``.
"""

from __future__ import annotations

import hashlib
import struct
import warnings
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image
from support.map_files import chunk, pgm, png

from gpusense.world.images import open_raster
from gpusense.world.map_files import read_map

LEVELS = np.arange(256)


def single(value: Fraction) -> Fraction:
    """Round a number in [-1, 128] to float32, halves to even."""
    if not value:
        return value
    scale = Fraction(2) ** 23
    while abs(value) * scale < 2**23:
        scale *= 2
    while abs(value) * scale >= 2**24:
        scale /= 2
    return round(value * scale) / scale


def cell(grey: int, free: float, occupied: float, mode: str, negate: bool) -> int:
    """Return nav2's cell of a grey, each operation rounded to float32."""
    p = single(Fraction(grey, 255))
    p = p if negate else single(1 - p)
    low, high = single(Fraction(free)), single(Fraction(occupied))
    if p <= low:
        return 0
    if p >= high:
        return 100
    if mode == "trinary":
        return -1
    share = single(single(p - low) / single(Fraction(occupied - free)))
    return int(single(share * 100) + Fraction(1, 2))


def cells_of(place, free: float, occupied: float, mode: str, negate: bool) -> np.ndarray:
    file = place(pgm([LEVELS]), free_thresh=free, occupied_thresh=occupied, mode=mode, negate=int(negate))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read_map(file).cells[0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_thresholds_of_every_grey(place, mode, negate):
    """At k / 255 a threshold and a grey are rounded differently in float32 and float64."""
    for k in range(255):
        found = cells_of(place, k / 255, (k + 1) / 255, mode, negate)
        near = [g for g in LEVELS if min(abs(g - k), abs(255 - g - k)) <= 2]
        assert [found[g] for g in near] == [cell(g, k / 255, (k + 1) / 255, mode, negate) for g in near]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("steps", "apart", "digest"),
    [
        (255, 1, "351e97a4b6b81fb5d5a70f4eb2156375748a564064c4a4066dd8c49605d3e183"),
        (20, 20, "c93c7e33c3d9218428a42688c38fb082e90fb8097770e9ca5969b0e05c0c8fce"),
    ],
)
def test_eigen_gives_the_same_bytes(place, steps, apart, digest):
    found = hashlib.sha256()
    for negate in (False, True):
        for free in range(steps):
            for occupied in range(free + 1, min(free + apart, steps) + 1):
                for mode in ("trinary", "scale"):
                    found.update(cells_of(place, free / steps, occupied / steps, mode, negate).tobytes())
    assert found.hexdigest() == digest


def test_graphicsmagick_gives_the_same_grey_for_each_of_16_million_colours(tmp_path):
    file = tmp_path / "all.ppm"
    number = np.arange(1 << 24, dtype=np.uint32)
    colours = np.stack([number >> 16, number >> 8 & 255, number & 255], axis=1).astype(np.uint8)
    file.write_bytes(b"P6\n4096 4096\n255\n" + colours.tobytes())
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for greys, _ in open_raster(stream, file, file.stat().st_size).strips:
            digest.update(greys.tobytes())
    assert digest.hexdigest() == "ce07af79cb5deab78ab2c93998e85685e0bf334e223be82765c948ab386d4708"


def luma(colour: np.ndarray) -> int:
    """Return the grey of a colour with channels of 8 bits, in rational arithmetic."""
    red, green, blue = (257 * int(channel) for channel in colour)
    return int(Fraction(299 * red + 587 * green + 114 * blue, 1000) + Fraction(1, 2)) // 257


@pytest.mark.parametrize("kind", ["ppm", "png", "palette", "alpha", "bmp"])
def test_coloured_maps(place, kind):
    rng = np.random.default_rng(1)
    # Half of them dark, for mode raw.
    colours = (rng.integers(0, 256, (16, 16, 3)) // rng.choice([1, 3], (16, 1, 1))).astype(np.uint8)
    greys = np.array([[luma(colour) for colour in row] for row in colours])
    if kind == "ppm":
        content = b"P6 16 16 255\n" + colours.tobytes()
    elif kind == "palette":
        pixels = b"".join(b"\0" + bytes(range(16 * row, 16 * row + 16)) for row in range(16))
        content = png(16, 16, pixels, colour=3, before=chunk(b"PLTE", colours.tobytes()))
    elif kind == "alpha":
        content = Image.fromarray(np.dstack([colours, np.full((16, 16), 255, np.uint8)]))
    else:
        content = Image.fromarray(colours)
    found = read_map(place(content, f"map.{'png' if kind in ('palette', 'alpha') else kind}", mode="raw"))
    np.testing.assert_array_equal(found.cells[::-1], np.where(greys <= 100, greys, -1))
    file = place(content, f"map.{'png' if kind in ('palette', 'alpha') else kind}", mode="scale")
    expected = [[cell(grey, 0.196, 0.65, "scale", False) for grey in row] for row in greys]
    np.testing.assert_array_equal(read_map(file).cells[::-1], expected)


def test_16_bit_greys_keep_whole_levels(place):
    """A level is reached at 257 times its number; a fraction of a level is dropped."""
    values = np.array([[256, 257, 25699, 25700, 25956, 25957, 65535]])
    expected = [[0, 1, 99, 100, 100, -1, -1]]
    raw = place(png(7, 1, b"\0" + values.astype(">u2").tobytes(), depth=16), "map.png", mode="raw")
    assert read_map(raw).cells.tolist() == expected
    assert read_map(place(pgm(values, 65535), mode="raw")).cells.tolist() == expected
    clear = chunk(b"tRNS", struct.pack(">H", 257))
    image = png(7, 1, b"\0" + values.astype(">u2").tobytes(), depth=16, before=clear)
    assert read_map(place(image, "map.png")).cells.tolist() == [[100, -1, -1, -1, -1, -1, 0]]


def test_free_unknown_cells_are_a_warning(place):
    file = place(pgm([[205, 205, 254, 0]]), free_thresh=0.25)
    with pytest.warns(UserWarning, match=r"map\.yaml: free_thresh: must be < 0\.196078 .* got 0\.25: 2 such cells"):
        assert read_map(file).cells.tolist() == [[0, 0, 0, 100]]


@pytest.mark.parametrize(
    ("greys", "changes"),
    [
        ([[205]], {}),
        ([[206, 0]], {"free_thresh": 0.25}),
        ([[205]], {"free_thresh": 0.25, "mode": "scale"}),
        ([[205]], {"free_thresh": 0.25, "mode": "raw"}),
        ([[205]], {"free_thresh": 0.25, "negate": 1}),
    ],
)
def test_no_warning_where_unknown_cells_are_not_freed(place, greys, changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_map(place(pgm(greys), **changes))


@pytest.mark.parametrize(
    ("text", "value"), [("010", 10.0), ("+08", 8.0), ("0.5", 0.5), ("010.25", 10.25), ("5e-1", 0.5)]
)
def test_numbers_are_decimal(place, text, value):
    file = place(pgm([[0]]))
    file.write_text(file.read_text().replace("resolution: 0.05", f"resolution: {text}"))
    assert read_map(file).resolution == value


@pytest.mark.parametrize("text", ["1:30", "1:30.5", "-1:30", "0o17"])
def test_other_numbers_are_refused(place, text):
    file = place(pgm([[0]]))
    file.write_text(file.read_text().replace("resolution: 0.05", f"resolution: {text}"))
    with pytest.raises(ValueError, match=rf"map\.yaml: resolution: must be .* got '{text}'"):
        read_map(file)
