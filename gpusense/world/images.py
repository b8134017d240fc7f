"""Read map images (PGM, PPM, PNG, BMP) as greys, strip by strip.

Pixels, bytes and memory are checked before decoding, so that memory is allocated only for data in the file.

Greys equal those of nav2_map_server 1.4 to 1.5, which reads images with the 16-bit build of GraphicsMagick 1.3.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense._util.memory import check_room
from gpusense.world.grid import OccupancyGrid

_MAX_CELLS = 1 << 29
_STRIP_CELLS = 1 << 20
# Memory for strips in progress, at up to 16 bytes a pixel.
_STRIPS_BYTES = 1 << 24
_MAX_PILLOW_WIDTH = 1 << 26  # keeps a strip of one row below Pillow's limit on pixels
_DIGITS = b"0123456789 "
_BLANKS_TO_SPACES = bytes.maketrans(b"\t\n\v\f\r", b"     ")

# Bytes of a pixel decoded by Pillow, by its mode; other modes take 4.
_PIXEL_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2}

# Shares of red, green and blue in a grey, in thousandths (ITU-R BT.601).
_LUMA = (299, 587, 114)

# A strip of image rows, topmost first: (h, w) greys, 0 black to 255 white, and the (h, w) mask of opaque pixels.
_Strip = tuple[NDArray[np.uint8], NDArray[np.bool] | None]


class Raster(NamedTuple):
    """Image, read strip by strip."""

    rows: int  # rows of pixels
    cols: int  # columns of pixels
    strips: Iterator[_Strip]  # strips of rows, topmost first


def open_raster(stream: BinaryIO, file: Path, size: int) -> Raster:
    """Open an image; its first bytes choose the format.

    ``file``: name of the file for messages; ``size``: length of the file [bytes].
    """
    magic = stream.read(8)
    stream.seek(0)
    if magic[:2] in (b"P2", b"P3", b"P5", b"P6"):
        return _open_pnm(stream, file, size)
    if magic == b"\x89PNG\r\n\x1a\n":
        return _open_pillow(stream, file, size, "PNG")
    if magic[:2] == b"BM":
        return _open_pillow(stream, file, size, "BMP")
    raise ValueError(f"{file}: must be a PGM, PPM, PNG or BMP image, got a file that begins with {magic!r}")


def _check_size(file: Path, rows: int, cols: int) -> None:
    if rows < 1 or cols < 1 or rows * cols > _MAX_CELLS:
        raise ValueError(f"{file}: must have 1 to {_MAX_CELLS} pixels, got {rows} rows of {cols}")


def _check_memory(file: Path, rows: int, cols: int, pixel: int = 0) -> None:
    """Check that the cells, and an image of ``pixel`` bytes a pixel that is decoded as a whole, fit into memory."""
    check_room(str(file), rows * cols * (1 + pixel) + _STRIPS_BYTES, f"{rows} x {cols} cells")


def _strip_rows(rows: int, cols: int) -> Iterator[tuple[int, int]]:
    """Return the first row of every strip and the row after its last."""
    height = max(1, _STRIP_CELLS // cols)
    return ((top, min(rows, top + height)) for top in range(0, rows, height))


def _open_pnm(stream: BinaryIO, file: Path, size: int) -> Raster:
    """Open a PGM or PPM image, plain (P2, P3) or raw (P5, P6), as the netpbm manual pages define them."""
    magic = stream.read(2)
    channels = 3 if magic in (b"P3", b"P6") else 1
    cols, rows, maxval = _pnm_header(stream, file)
    _check_size(file, rows, cols)
    begin = stream.tell()
    if not 1 <= maxval <= 65535:
        raise ValueError(f"{file}: must have a maximum value of 1 to 65535, got {maxval}")
    count = rows * cols * channels
    width = 1 if maxval < 256 else 2
    plain = magic in (b"P2", b"P3")
    needed = 2 * count - 1 if plain else width * count  # a plain value takes a digit and a blank
    stream.seek(0)
    header, next_byte = stream.read(begin), stream.read(1)
    # CR LF ends the header if its other lines end in CR LF, or if the file is one byte longer than the raster.
    crlf = header.endswith(b"\r") and next_byte == b"\n"
    begin += crlf and (b"\r\n" in header or size - begin == needed + 1)
    stream.seek(begin)
    available = size - begin
    if available < needed:
        raise ValueError(f"{file}: must have a raster of at least {needed} bytes, got {available}")
    _check_memory(file, rows, cols)

    steps = _steps(maxval)

    def strips() -> Iterator[_Strip]:
        pieces = _plain_values(stream, file)
        ready: NDArray[Any] = np.empty(0, np.uint32)
        for top, end in _strip_rows(rows, cols):
            number = (end - top) * cols * channels
            if plain:
                while len(ready) < number:
                    if (piece := next(pieces, None)) is None:
                        found = top * cols * channels + len(ready)
                        raise ValueError(f"{file}: must have {count} values, got {found}")
                    ready = np.concatenate([ready, piece])
                block, ready = ready[:number], ready[number:]
            else:
                block = np.frombuffer(stream.read(width * number), f">u{width}")
            if block.max() > maxval:
                raise ValueError(f"{file}: every value must be at most {maxval}, got {block.max()}")
            yield _greys(block.reshape(end - top, cols, channels), steps), None

    return Raster(rows, cols, strips())


def _pnm_header(stream: BinaryIO, file: Path) -> list[int]:
    """Read width, height and maximum value after the magic number, up to the first byte of the raster."""
    numbers: list[int] = []
    token = b""
    comment = False
    for _ in range(1 << 16):
        byte = stream.read(1)
        if comment or byte == b"#":
            comment = byte not in (b"\n", b"\r")
        elif byte.isdigit() and len(token) < 10:
            token += byte
            continue
        elif not byte.isspace():
            break
        if token:
            numbers.append(int(token))
            token = b""
        if len(numbers) == 3 and not comment:
            return numbers
    raise ValueError(f"{file}: must have a header of width, height and maximum value, got {numbers}")


def _plain_values(stream: BinaryIO, file: Path) -> Iterator[NDArray[np.uint32]]:
    """Yield the decimal numbers of a stream in pieces."""
    rest = b""
    while chunk := stream.read(1 << 18):
        head, _, rest = (rest + chunk).translate(_BLANKS_TO_SPACES).rpartition(b" ")
        yield _decimals(head, rest, file)
    yield _decimals(rest, b"", file)


def _decimals(text: bytes, rest: bytes, file: Path) -> NDArray[np.uint32]:
    tokens = text.split()
    if text.translate(None, _DIGITS) or len(rest) > 10 or any(len(token) > 9 for token in tokens):
        raise ValueError(f"{file}: must have a raster of decimal numbers, got something else")
    return np.array([int(token) for token in tokens], np.uint32)


@contextlib.contextmanager
def _decoding(file: Path, kind: str) -> Iterator[None]:
    """Convert errors of Pillow, zlib or struct about a broken image to a ValueError."""
    try:
        yield
    except (LookupError, OSError, SyntaxError, TypeError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise ValueError(f"{file}: must be a whole {kind} image, got a broken one: {error}") from error


def _check_png(stream: BinaryIO) -> None:
    """Check, in little memory, that the image data of a PNG inflates to the size in its header.

    Pillow allocates by the header and leaves missing pixels black, as if they were walls.
    """
    stream.seek(16)
    cols, rows, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", stream.read(13))
    bits = depth * {2: 3, 4: 2, 6: 4}.get(colour, 1)
    # Passes of Adam7: first column, first row, column step, row step.
    adam7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    claimed = 0
    for x, y, dx, dy in adam7 if interlace else ((0, 0, 1, 1),):
        width, height = -((x - cols) // dx), -((y - rows) // dy)
        if width > 0:
            claimed += max(height, 0) * (1 + (width * bits + 7) // 8)
    inflater = zlib.decompressobj()
    inflated = 0
    for piece in _png_data(stream):
        while piece and inflated <= claimed:
            inflated += len(inflater.decompress(piece, 1 << 20))
            piece = inflater.unconsumed_tail
        if inflater.eof or inflated > claimed:
            break
    else:
        inflated += len(inflater.flush())
    if inflated < claimed or (inflated == claimed and not inflater.eof):
        raise ValueError(f"its data inflates to {inflated} of {claimed} bytes")


def _png_data(stream: BinaryIO) -> Iterator[bytes]:
    """Read the contents of a PNG's IDAT chunks, piece by piece."""
    stream.seek(33)  # after the signature and the chunk IHDR
    while True:
        length, kind = struct.unpack(">I4s", stream.read(8))
        if kind == b"IEND":
            return
        while kind == b"IDAT" and length > 0:
            piece = stream.read(min(length, 1 << 16))
            if not piece:
                raise EOFError("the file ends within its data")
            length -= len(piece)
            yield piece
        stream.seek(length + 4, os.SEEK_CUR)


def _open_pillow(stream: BinaryIO, file: Path, size: int, kind: str) -> Raster:
    """Open a PNG or BMP image with Pillow."""
    image = _load_pillow(stream, file, size, kind)
    cols, rows = image.size
    transparent = image.info.get("transparency")
    mode = {"1": "L", "P": "RGB"}.get(image.mode, image.mode)
    if transparent is not None:
        mode = {"L": "LA", "RGB": "RGBA"}.get(mode, mode)
    steps = _steps(65535 if mode.startswith("I") else 255)  # 16 bits of grey, or 8
    colours = 3 if mode.startswith("RGB") else 1

    def strips() -> Iterator[_Strip]:
        for top, end in _strip_rows(rows, cols):
            strip = image.crop((0, top, cols, end))
            values = np.asarray(strip if strip.mode == mode else strip.convert(mode))
            values = values.reshape(end - top, cols, -1)
            opaque = None
            if mode.endswith("A"):
                opaque = values[:, :, -1] == 255
            elif transparent is not None:
                opaque = values[:, :, 0] != transparent
            yield _greys(values[:, :, :colours], steps), opaque

    return Raster(rows, cols, strips())


def _load_pillow(stream: BinaryIO, file: Path, size: int, kind: str) -> Any:
    """Load a PNG or BMP image after checking its size.

    Image.open is avoided: its pixel limit is process-wide and too small for large maps.
    """
    from PIL.BmpImagePlugin import BmpImageFile
    from PIL.PngImagePlugin import PngImageFile

    with _decoding(file, kind):
        stream.seek(0)
        image = PngImageFile(stream) if kind == "PNG" else BmpImageFile(stream)
    cols, rows = image.size
    _check_size(file, rows, cols)
    if cols > _MAX_PILLOW_WIDTH:
        raise ValueError(f"{file}: must be at most {_MAX_PILLOW_WIDTH} pixels wide, got {cols}")
    if kind == "BMP":
        codec, _, offset, args = image.tile[0]
        if codec != "raw" or not isinstance(args, tuple):
            raise ValueError(f"{file}: must be an uncompressed BMP image, got a compressed one")
        needed = offset + rows * args[1]
        if size < needed:
            raise ValueError(f"{file}: must have at least {needed} bytes, got {size}")
    _check_memory(file, rows, cols, _PIXEL_BYTES.get(image.mode, 4))
    with _decoding(file, kind):
        if kind == "PNG":
            _check_png(stream)
        image.load()
    return image


def mapped(values: NDArray[Any], table: NDArray[Any]) -> NDArray[Any]:
    """Return ``table[values]``; bytes are mapped at the speed of memory."""
    if values.dtype != np.uint8 or table.itemsize != 1:
        return table[values]
    full = np.zeros(256, table.dtype)
    full[: len(table)] = table
    if full.dtype == np.uint8 and (full == np.arange(256)).all():
        return values
    return np.frombuffer(values.tobytes().translate(full.tobytes()), table.dtype).reshape(values.shape)


def _steps(maxval: int) -> NDArray[np.uint32]:
    """Return the 16-bit value of each value of a channel, rounded half up."""
    values = np.arange(maxval + 1, dtype=np.uint64)
    steps: NDArray[np.uint32] = ((2 * 65535 * values + maxval) // (2 * maxval)).astype(np.uint32)
    return steps


def _greys(values: NDArray[Any], steps: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Return (h, w) greys of (h, w, C) channels: the luma in 16 bits, rounded half up, then scaled to 8."""
    if values.shape[2] == 1:
        return mapped(values[:, :, 0], (steps // 257).astype(np.uint8))
    luma = np.full(values.shape[:2], 500, np.uint32)
    for channel, share in enumerate(_LUMA):
        luma += (share * steps).astype(np.uint32)[values[:, :, channel]]
    return (luma // 1000 // 257).astype(np.uint8)


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
