"""Images of maps: formats, depths, transparency, and files with false headers."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from support.map_files import CELLS, GREYS, chunk, pgm, png, yaml_text

from gpusense._util import memory
from gpusense.world import images
from gpusense.world.map_files import read_map


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_pixels_that_are_not_opaque_are_unknown(place, mode):
    image = Image.fromarray(np.array([[[0, 255], [0, 254], [255, 255], [255, 0]]], np.uint8), "LA")
    assert read_map(place(image, "map.png", mode=mode)).cells.tolist() == [[100, -1, 0, -1]]


def test_raw_ignores_alpha(place):
    image = Image.fromarray(np.array([[[7, 255], [9, 0]]], np.uint8), "LA")
    assert read_map(place(image, "map.png", mode="raw")).cells.tolist() == [[7, 9]]


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("P5", pgm(GREYS)),
        ("P5 with comments", b"P5 # made by\n# hand\n2 # columns\n2\n255\n" + GREYS.tobytes()),
        ("P5 and a line feed", pgm(GREYS) + b"\n"),
        ("P5 with CRLF", b"P5\r\n2 2\r\n255\r\n" + GREYS.tobytes()),
        ("P5 with CRLF and comments", b"P5\r\n# made by\r\n2 2\r\n255\r\n" + GREYS.tobytes() + b"\r\n"),
        ("P5 with one CRLF", b"P5 2 2 255\r\n" + GREYS.tobytes()),
        ("P5 with CR", b"P5\r2 2\r255\r" + GREYS.tobytes()),
        ("P6 with CRLF", b"P6\r\n2 2\r\n255\r\n" + GREYS.repeat(3).tobytes()),
        ("P5 of 16 bits", pgm(GREYS.astype(int) * 257, 65535)),
        ("P5 of 10 bits", pgm(GREYS * 4.0, 1020)),
        ("P5 of 1 bit", None),
        ("P2", b"P2\n2 2\n255\n0 205\n254 89"),
        ("P2 on one line", b"P2 2 2 255 000 205\t254\r\n89 "),
        ("P2 of 16 bits", b"P2 2 2 65535 0 52685 65278 22873\n"),
        ("P3", b"P3 2 2 255 0 0 0 205 205 205 254 254 254 89 89 89\n"),
    ],
)
def test_netpbm(place, name, image):
    if image is None:
        assert read_map(place(pgm([[0, 1]], 1))).cells.tolist() == [[100, 0]]
    else:
        assert read_map(place(image)).cells.tolist() == CELLS


def test_a_raster_may_begin_with_a_line_feed(place):
    assert read_map(place(b"P5 2 2 255\r" + bytes([10, 0, 0, 0]), mode="raw")).cells.tolist() == [[0, 0], [10, 0]]
    with pytest.raises(ValueError, match="must have a raster of at least 4 bytes, got 3"):
        read_map(place(b"P5\r\n2 2\r\n255\r\n" + bytes(3)))


def test_16_bits_are_a_fraction_of_their_own_maximum(place):
    # Greys 89 and 90, 206 and 205: 90 is reached at 90 / 255 of the maximum.
    file = place(pgm([[352, 353, 808, 807]], 1000), free_thresh=0.196)
    assert read_map(file).cells.tolist() == [[100, -1, 0, -1]]
    file = place(pgm([[21176, 21177, 48471, 48470]], 60000), free_thresh=0.196)
    assert read_map(file).cells.tolist() == [[100, -1, 0, -1]]


def grey_png_16():
    # Grey 90 is not occupied and begins at 90 * 257 = 23130.
    rows = np.array([[23129, 23130]], ">u2")
    return png(2, 1, b"\0" + rows.tobytes(), depth=16)


def test_16_bit_grey_png(place):
    assert read_map(place(grey_png_16(), "map.png")).cells.tolist() == [[100, -1]]
    clear = chunk(b"tRNS", struct.pack(">H", 22937))
    image = png(2, 1, b"\0" + np.array([[22937, 0]], ">u2").tobytes(), depth=16, before=clear)
    assert read_map(place(image, "map.png")).cells.tolist() == [[-1, 100]]


def test_16_bit_colour_and_alpha_png(place):
    rgba = np.array([[[0, 0, 0, 65535], [65535, 65535, 65535, 65535], [0, 0, 0, 1]]], ">u2")
    image = png(3, 1, b"\0" + rgba.tobytes(), depth=16, colour=6)
    assert read_map(place(image, "map.png")).cells.tolist() == [[100, 0, -1]]
    image = png(2, 1, b"\0" + rgba[:, :2, :3].tobytes(), depth=16, colour=2)
    assert read_map(place(image, "map.png")).cells.tolist() == [[100, 0]]
    image = png(3, 1, b"\0" + rgba[:, :, 2:].tobytes(), depth=16, colour=4)
    assert read_map(place(image, "map.png")).cells.tolist() == [[100, 0, -1]]


@pytest.mark.parametrize("suffix", ["png", "bmp"])
@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P"])
def test_pillow_formats(place, suffix, mode):
    image = Image.fromarray(GREYS).convert(mode)
    assert read_map(place(image, f"map.{suffix}")).cells.tolist() == CELLS


@pytest.mark.parametrize("suffix", ["png", "bmp"])
def test_one_bit(place, suffix):
    image = Image.fromarray(np.array([[0, 255], [255, 255]], np.uint8)).convert("1")
    assert read_map(place(image, f"map.{suffix}")).cells.tolist() == [[0, 0], [100, 0]]


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_small_grey_depths(place, depth):
    white = 2**depth - 1
    packed = white << (8 - depth)  # A white pixel, then a black one.
    assert read_map(place(png(2, 1, bytes([0, packed]), depth), "map.png")).cells.tolist() == [[0, 100]]


def test_palette_with_alpha(place):
    image = Image.fromarray(np.array([[0, 1, 2]], np.uint8), "P")
    image.putpalette([0, 0, 0, 255, 255, 255, 0, 0, 0])
    file = place(image, "map.png", save={"transparency": bytes([255, 255, 0])})
    assert read_map(file).cells.tolist() == [[100, 0, -1]]


@pytest.mark.parametrize(("mode", "clear"), [("L", 0), ("RGB", (0, 0, 0)), ("1", 0)])
def test_a_transparent_colour(place, mode, clear):
    image = Image.fromarray(np.array([[0, 255]], np.uint8)).convert(mode)
    file = place(image, "map.png", save={"transparency": clear})
    assert read_map(file).cells.tolist() == [[-1, 0]]


@pytest.mark.parametrize(("cols", "rows"), [(1, 1), (1, 9), (9, 1), (3, 3), (5, 7), (16, 17)])
def test_interlaced_png(place, cols, rows):
    # Adam7 splits an image into passes, some of them empty: the expected number of bytes must hold for all.
    bits = 8
    passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    raster = b""
    for x, y, dx, dy in passes:
        width, height = len(range(x, cols, dx)), len(range(y, rows, dy))
        if width:
            raster += (b"\0" + b"\xff" * (width * bits // 8)) * height
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", cols, rows, 8, 0, 0, 0, 1))
    whole = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(raster)) + chunk(b"IEND", b"")
    short = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(raster[:-1])) + chunk(b"IEND", b"")
    assert read_map(place(whole, "map.png")).cells.tolist() == [[0] * cols] * rows
    with pytest.raises(ValueError, match="inflates to"):
        read_map(place(short, "map.png"))


def test_image_data_in_many_chunks(place):
    rng = np.random.default_rng(0)
    greys = rng.choice(np.array([0, 205, 254], np.uint8), (300, 300))
    packed = zlib.compress(b"".join(b"\0" + row.tobytes() for row in greys))
    head = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 300, 300, 8, 0, 0, 0, 0))
    data = b"".join(chunk(b"IDAT", packed[i : i + 1000]) for i in range(0, len(packed), 1000))
    from_png = read_map(place(head + data + chunk(b"IEND", b""), "map.png"))
    assert from_png == read_map(place(pgm(greys)))


@pytest.mark.parametrize("kind", ["P2", "P5", "P6", "png", "bmp"])
def test_every_strip_has_its_place(place, monkeypatch, kind):
    monkeypatch.setattr(images, "_STRIP_CELLS", 16)
    greys = np.random.default_rng(1).choice(np.array([0, 205, 254], np.uint8), (13, 7))
    expected = np.where(greys == 0, 100, np.where(greys == 254, 0, -1))[::-1]
    if kind == "P2":
        content = b"P2 7 13 255\n" + " ".join(map(str, greys.ravel())).encode()
    elif kind == "P5":
        content = pgm(greys)
    elif kind == "P6":
        content = b"P6 7 13 255\n" + np.repeat(greys[:, :, None], 3, axis=2).tobytes()
    else:
        content = Image.fromarray(greys)
    np.testing.assert_array_equal(read_map(place(content, f"map.{kind}")).cells, expected)


def test_a_long_plain_raster_is_read_in_pieces(place):
    greys = np.full(600_000, 205)
    greys[::7] = 0
    content = b"P2 1000 600 255\n" + " ".join(map(str, greys)).encode()
    grid = read_map(place(content))
    np.testing.assert_array_equal(grid.cells[::-1].ravel(), np.where(greys == 0, 100, -1))


@pytest.mark.parametrize("keep", ["magic", "header", "half", "all but one"])
@pytest.mark.parametrize("kind", ["P2", "P5", "P6", "png", "bmp"])
def test_truncated_images(place, kind, keep):
    greys = np.random.default_rng(2).integers(0, 256, (40, 40), np.uint8)
    if kind == "P2":
        content = b"P2 40 40 255\n" + b" ".join(b"%d" % v for v in greys.ravel())
        # Half a number is still a number, so a whole one is cut off.
        ends = {"magic": 2, "header": 12, "half": len(content) // 2, "all but one": content.rindex(b" ")}
    else:
        if kind == "P5":
            content = pgm(greys)
        elif kind == "P6":
            content = b"P6 40 40 255\n" + np.repeat(greys[:, :, None], 3, axis=2).tobytes()
        else:
            path = place(Image.fromarray(greys), f"map.{kind}").with_name(f"map.{kind}")
            content = path.read_bytes()
        # The last 16 bytes of a PNG are a checksum and an empty chunk; the pixels are whole without them.
        last = len(content) - (17 if kind == "png" else 1)
        ends = {"magic": 3, "header": 20, "half": len(content) // 2, "all but one": last}
    file = place(content[: ends[keep]], f"map.{kind}")
    with pytest.raises(ValueError, match=f"map.{kind}: must "):
        read_map(file)


@pytest.mark.parametrize("size", [(20_000, 20_000), (100_000, 100_000), (2**31 - 1, 2**31 - 1)])
def test_claimed_sizes_are_not_believed(place, size):
    import tracemalloc

    cols, rows = size
    small = Image.fromarray(np.zeros((4, 4), np.uint8))
    bmp = bytearray(place(small, "map.bmp").with_name("map.bmp").read_bytes())
    bmp[18:26] = struct.pack("<ii", cols, rows)
    liars = {
        "map.pgm": b"P5 %d %d 255\n" % size + bytes(1000),
        "plain.pgm": b"P2 %d %d 255\n" % size + b"0 " * 1000,
        "map.png": png(cols, rows, bytes(1000)),
        "map.bmp": bytes(bmp),
    }
    for name, content in liars.items():
        file = place(content, name)
        tracemalloc.start()
        with pytest.raises(ValueError, match=f"{name}: must have|{name}: must be a whole"):
            read_map(file)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 4 << 20


@settings(max_examples=40, deadline=None)
@given(data=st.data(), kind=st.sampled_from(["pgm", "png", "bmp"]))
def test_damaged_images_never_raise_anything_else(tmp_path_factory, data, kind):
    folder = tmp_path_factory.mktemp("damaged")
    file = folder / f"map.{kind}"
    if kind == "pgm":
        content = bytearray(pgm(np.full((8, 8), 205)))
    else:
        Image.fromarray(np.full((8, 8), 205, np.uint8)).save(file)
        content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    (folder / "map.yaml").write_text(yaml_text(file.name))
    try:
        read_map(folder / "map.yaml")
    except ValueError as error:
        assert str(file) in str(error)


BOUND = 3000
"""Side of images whose memory is measured."""


def big_image(kind: str) -> bytes:
    """Return the contents of a large image."""
    side = BOUND
    if kind == "pgm":
        return pgm(np.zeros((side, side), np.uint8))
    if kind == "pgm-plain":
        return b"P2 %d %d 255\n" % (side, side) + b"0 " * (side * side)
    if kind == "png":
        return png(side, side, bytes(side * (1 + side)))
    return png(side, side, bytes(side * (1 + (side + 7) // 8)), depth=1)


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("kind", ["png-1-bit", "png", "pgm", "pgm-plain"])
def test_a_map_is_read_at_a_byte_a_cell(tmp_path, kind):
    """Count the memory of NumPy and Python; Pillow holds one more byte a pixel of a grey PNG without reporting it."""
    name = f"map.{kind[:3]}"
    (tmp_path / name).write_bytes(big_image(kind))
    (tmp_path / "map.yaml").write_text(yaml_text(name))
    read_map(tmp_path / "map.yaml")
    tracemalloc.start()
    try:
        grid = read_map(tmp_path / "map.yaml")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert grid.shape == (BOUND, BOUND) and grid.occupied.all()
    assert peak < 1.3 * BOUND * BOUND + 24e6


@pytest.mark.parametrize("name", ["map.pgm", "map.png", "map.bmp"])
def test_a_map_beyond_the_memory_is_refused_before_it_is_decoded(tmp_path, monkeypatch, name):
    Image.fromarray(np.zeros((100, 100), np.uint8)).save(tmp_path / name, "PPM" if name.endswith("pgm") else None)
    (tmp_path / "map.yaml").write_text(yaml_text(name))
    assert read_map(tmp_path / "map.yaml").shape == (100, 100)
    monkeypatch.setattr(memory, "available", lambda: 1 << 20)
    with pytest.raises(MemoryError, match=f"{name}: 100 x 100 cells must fit into the available memory, 1.05 MB, got"):
        read_map(tmp_path / "map.yaml")


def test_the_available_memory_is_that_of_the_machine_its_container_and_the_process():
    room = memory.available()
    assert room is None or 1 << 20 < room < 1 << 60
    memory.check_room("x", 1, "a cell")
    with pytest.raises(MemoryError, match=r"^x: 3 cells must fit into the available memory"):
        memory.check_room("x", 1 << 62, "3 cells")
