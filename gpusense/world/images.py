"""Read map images (PGM, PPM, PNG, BMP) as greys, strip by strip; memory is allocated only for data that the file holds.

Greys are those of nav2_map_server 1.4 to 1.5, which reads images with the 16-bit build of GraphicsMagick 1.3.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

_MAX_CELLS = 1 << 31
_STRIP_CELLS = 1 << 20
_MAX_PILLOW_WIDTH = 1 << 26  # keeps a strip of one row below Pillow's limit on pixels
_DIGITS = b"0123456789 "
_BLANKS_TO_SPACES = bytes.maketrans(b"\t\n\v\f\r", b"     ")

# Shares of red, green and blue in a grey, in thousandths (ITU-R BT.601).
_LUMA = (299, 587, 114)

# A strip of image rows, topmost first: (h, w) greys, 0 black to 255 white, and the (h, w) mask of opaque pixels.
_Strip = tuple[NDArray[np.uint8], NDArray[np.bool] | None]


@dataclass(frozen=True)
class Raster:
    """An image that is read strip by strip.

    Attributes:
        rows: Rows of pixels.
        cols: Columns of pixels.
        strips: Strips of rows, topmost first.
    """

    rows: int
    cols: int
    strips: Iterator[_Strip]


def open_raster(stream: BinaryIO, file: Path, size: int) -> Raster:
    """Open an image; its first bytes choose the format.

    Args:
        stream: The open file.
        file: Name of the file for messages.
        size: Length of the file [bytes].

    Raises:
        ValueError: The format is unknown, or the file breaks it.
    """
    magic = stream.read(8)
    stream.seek(0)
    if magic[:2] in (b"P2", b"P3", b"P5", b"P6"):
        return _open_pnm(stream, file, size)
    if magic == b"\x89PNG\r\n\x1a\n":
        with _decoding(file, "PNG"):
            _check_png(stream)
        return _open_pillow(stream, file, size, "PNG")
    if magic[:2] == b"BM":
        return _open_pillow(stream, file, size, "BMP")
    raise ValueError(f"{file}: must be a PGM, PPM, PNG or BMP image, got a file that begins with {magic!r}")


def _check_size(file: Path, rows: int, cols: int) -> None:
    if rows < 1 or cols < 1 or rows * cols > _MAX_CELLS:
        raise ValueError(f"{file}: must have 1 to {_MAX_CELLS} pixels, got {rows} rows of {cols}")


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
    if not 1 <= maxval <= 65535:
        raise ValueError(f"{file}: must have a maximum value of 1 to 65535, got {maxval}")
    count = rows * cols * channels
    width = 1 if maxval < 256 else 2
    plain = magic in (b"P2", b"P3")
    needed = 2 * count - 1 if plain else width * count  # a plain value takes a digit and a blank
    available = size - stream.tell()
    if available < needed:
        raise ValueError(f"{file}: must have a raster of at least {needed} bytes, got {available}")

    steps = _steps(maxval)

    def strips() -> Iterator[_Strip]:
        values = _plain_values(stream, file, count) if plain else None
        for top, end in _strip_rows(rows, cols):
            first, last = top * cols * channels, end * cols * channels
            if values is not None:
                block = values[first:last]
            else:
                block = np.frombuffer(stream.read(width * (last - first)), f">u{width}")
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


def _plain_values(stream: BinaryIO, file: Path, count: int) -> NDArray[np.uint32]:
    """Read the first ``count`` decimal numbers of the stream."""
    values = np.empty(count, np.uint32)
    filled = 0
    rest = b""
    while filled < count:
        chunk = stream.read(1 << 20)
        head, _, rest = (rest + chunk).translate(_BLANKS_TO_SPACES).rpartition(b" ")
        if not chunk:
            head, rest = rest, b""
        tokens = head.split()
        if head.translate(None, _DIGITS) or len(rest) > 10 or any(len(token) > 9 for token in tokens):
            raise ValueError(f"{file}: must have a raster of decimal numbers, got something else")
        tokens = tokens[: count - filled]
        if not tokens and not chunk:
            raise ValueError(f"{file}: must have {count} values, got {filled}")
        values[filled : filled + len(tokens)] = [int(token) for token in tokens]
        filled += len(tokens)
    return values


@contextlib.contextmanager
def _decoding(file: Path, kind: str) -> Iterator[None]:
    """Convert errors of Pillow, zlib or struct about a broken image to a ValueError."""
    try:
        yield
    except (OSError, SyntaxError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise ValueError(f"{file}: must be a whole {kind} image, got a broken one: {error}") from error


def _check_png(stream: BinaryIO) -> None:
    """Check, in little memory, that the image data of a PNG inflates to the size in its header.

    Pillow allocates by the header, and leaves missing pixels black: they would become walls.
    """
    cols, rows, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", stream.read(29)[16:])
    bits = depth * {2: 3, 4: 2, 6: 4}.get(colour, 1)
    # The passes of Adam7: first column, first row, step along the columns, step along the rows.
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

    Image.open is avoided: its limit on pixels is a setting of the whole process, and smaller than large maps.
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
    with _decoding(file, kind):
        image.load()
    return image


def _steps(maxval: int) -> NDArray[np.uint32]:
    """Return the 16-bit value of each value of a channel, rounded half up."""
    values = np.arange(maxval + 1, dtype=np.uint64)
    steps: NDArray[np.uint32] = ((2 * 65535 * values + maxval) // (2 * maxval)).astype(np.uint32)
    return steps


def _greys(values: NDArray[Any], steps: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Return the (h, w) greys of (h, w, C) channels: the luma in 16 bits, rounded half up, of which 8 bits are kept."""
    if values.shape[2] == 1:
        grey: NDArray[np.uint8] = (steps // 257).astype(np.uint8)[values[:, :, 0]]
        return grey
    luma = np.full(values.shape[:2], 500, np.uint32)
    for channel, share in enumerate(_LUMA):
        luma += (share * steps).astype(np.uint32)[values[:, :, channel]]
    return (luma // 1000 // 257).astype(np.uint8)
