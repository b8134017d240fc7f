"""Maps as ROS map_server writes them: a YAML file beside a PGM, PNG or BMP image."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense import _checks
from gpusense.grid import OccupancyGrid

_MAX_YAML_BYTES = 1 << 20
_MAX_CELLS = 1 << 31
_STRIP_CELLS = 1 << 20
_MAX_PILLOW_WIDTH = 1 << 26  # so that no strip of a row meets Pillow's own limit on pixels
_DIGITS = b"0123456789 "
_BLANKS_TO_SPACES = bytes.maketrans(b"\t\n\v\f\r", b"     ")

# A strip of image rows, topmost first: the sum of the colour channels (h, w), and where the image is opaque.
_Strip = tuple[NDArray[np.uint32], NDArray[np.bool] | None]


@dataclass(frozen=True)
class _Raster:
    """An image that is read strip by strip; ``white`` is the sum of the channels of a white pixel."""

    rows: int
    cols: int
    white: int
    strips: Iterator[_Strip]


@dataclass(frozen=True)
class _MapYaml:
    image: Path
    resolution: float
    origin: ArrayLike
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: str


def read_map(path: str | os.PathLike[str], *, occupied_threshold: int = 65) -> OccupancyGrid:
    """Read a map in the format of ROS map_server.

    The values follow nav2_map_server. With v the mean of the colour channels as a fraction of white, the
    occupancy is p = 1 - v, or v with ``negate``. Modes ``trinary`` (the default) and ``scale``: p >=
    ``occupied_thresh`` is 100, p <= ``free_thresh`` is 0; between them trinary is unknown and scale is
    ``round(100 (p - free_thresh) / (occupied_thresh - free_thresh))``; a pixel that is not opaque is unknown.
    Mode ``raw``: round(255 v), unknown where that exceeds 100. The image's bottom row is ``cells[0]``.

    The image is told by its content: PGM (P2, P5; 8 or 16 bits), PPM (P3, P6), PNG (1 to 16 bits; grey,
    palette or colour, with or without alpha) or uncompressed BMP. A 16-bit value is a fraction of its own
    maximum, except in a PNG with colours or alpha, of which the upper 8 bits are used. Nothing is allocated
    on the word of a header alone: the file must hold the pixels that its header claims, and at most 2^31.

    Args:
        path: the YAML file; its ``image`` is relative to its folder.
        occupied_threshold: passed on to :class:`OccupancyGrid` [per cent].

    Raises:
        FileNotFoundError: the YAML file or its image is missing.
        TypeError: ``path`` or ``occupied_threshold`` is not of the kind described.
        ValueError: a file breaks the format; the message names the file and the rule.
    """
    meta = _read_yaml(_checks.existing_file(_checks.path("path", path)))
    size = meta.image.stat().st_size
    with meta.image.open("rb") as stream:
        raster = _open_raster(stream, meta.image, size)
        table = _cell_table(meta, raster.white)
        cells = np.empty((raster.rows, raster.cols), np.int8)
        end = raster.rows
        for shade, opaque in raster.strips:
            block = table[shade]
            if opaque is not None and meta.mode != "raw":
                block[~opaque] = -1
            cells[end - len(block) : end] = block[::-1]
            end -= len(block)
    return OccupancyGrid(cells, meta.resolution, meta.origin, occupied_threshold=occupied_threshold)


def write_map(
    grid: OccupancyGrid, path: str | os.PathLike[str], *, image_format: Literal["pgm", "png"] = "pgm"
) -> None:
    """Write a map for ROS map_server, whole or not at all.

    The image has the YAML file's name with the suffix of its format. A grid of 0, 100 and unknown is written
    in mode ``trinary`` with map_saver's greys (254, 0 and 205, ``free_thresh`` 0.196); any other in mode
    ``raw`` with 255 for unknown. :func:`read_map` gives equal cells, resolution and origin back. The grid's
    ``occupied_threshold`` is no part of the format.

    Args:
        grid: the map.
        path: the YAML file, ending in .yaml or .yml. It and its image are replaced if they exist.
        image_format: ``"pgm"`` or ``"png"``.

    Raises:
        FileNotFoundError: the folder is missing.
        TypeError: an argument is not of the kind described.
        ValueError: ``path`` has another suffix or is a folder, or ``image_format`` is unknown.
        OSError: the files cannot be written; those of before are then still there.
    """
    import yaml

    if not isinstance(grid, OccupancyGrid):
        raise TypeError(f"grid: must be an OccupancyGrid, got {_checks.show(grid)}")
    target = _checks.path("path", path)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"path: must end in .yaml or .yml, got {target}")
    _checks.choice("image_format", image_format, ("pgm", "png"))
    image = target.with_suffix(f".{image_format}")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"path: must lie in a folder that exists, got {target}")
    for file in (target, image):
        if file.is_dir():
            raise ValueError(f"path: must not name a folder, got {file}")

    cells = grid.cells
    trinary = sum(np.count_nonzero(cells == value) for value in (0, 100, -1)) == cells.size
    greys = bytearray([*range(101), *[255] * 155])  # by the cell's byte; that of unknown, -1, is 255
    if trinary:
        greys[0], greys[100], greys[255] = 254, 0, 205
    pixels = cells[::-1].tobytes().translate(greys)
    meta = {
        "image": image.name,
        "mode": "trinary" if trinary else "raw",
        "resolution": grid.resolution,
        "origin": list(grid.origin),
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    text = yaml.safe_dump(meta, sort_keys=False, default_flow_style=None, allow_unicode=True)
    writers: dict[Path, Callable[[BinaryIO], object]] = {
        image: lambda stream: _write_image(stream, pixels, grid.shape, image_format),
        target: lambda stream: stream.write(text.encode()),
    }
    _write_all(writers)


def _write_image(stream: BinaryIO, pixels: bytes, shape: tuple[int, int], image_format: str) -> None:
    size = shape[::-1]
    if image_format == "png":
        from PIL import Image

        Image.frombytes("L", size, pixels).save(stream, "PNG")
    else:
        stream.write(b"P5\n%d %d\n255\n" % size)
        stream.write(pixels)


def _write_all(writers: dict[Path, Callable[[BinaryIO], object]]) -> None:
    """Write files so that either all are replaced or, whatever happens, all are as before."""
    tag = secrets.token_hex(4)
    fresh = {target: target.with_name(f".{target.name}.{tag}.new") for target in writers}
    kept = {target: target.with_name(f".{target.name}.{tag}.old") for target in writers}
    existed = {target: target.exists() for target in writers}
    try:
        for target, write in writers.items():
            with fresh[target].open("xb") as stream:
                write(stream)
        for target in writers:
            if existed[target]:
                os.replace(target, kept[target])
            os.replace(fresh[target], target)
    except BaseException:
        for target in writers:
            if kept[target].exists():
                os.replace(kept[target], target)
            elif not existed[target]:
                target.unlink(missing_ok=True)
        raise
    else:
        for file in kept.values():
            file.unlink(missing_ok=True)
    finally:
        for file in fresh.values():
            file.unlink(missing_ok=True)


def _read_yaml(file: Path) -> _MapYaml:
    import yaml

    with file.open("rb") as stream:
        text = stream.read(_MAX_YAML_BYTES + 1)
    if len(text) > _MAX_YAML_BYTES:
        raise ValueError(f"{file}: must be a YAML file of at most {_MAX_YAML_BYTES} bytes, got a larger file")
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ValueError(f"{file}: must be plain YAML, got an error{where}: {problem}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{file}: must hold a YAML mapping, got {_checks.show(data)}")
    for key in ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"):
        if key not in data:
            raise ValueError(f"{file}: must have the key {key!r}, got {_checks.show(list(data))}")

    image, origin, negate, mode = data["image"], data["origin"], data["negate"], data.get("mode", "trinary")
    if not isinstance(image, str) or not image or "\0" in image:
        raise ValueError(f"{file}: image: must be a file name, got {_checks.show(image)}")
    if not isinstance(origin, list) or len(origin) != 3:
        raise ValueError(f"{file}: origin: must be a list of x, y and yaw, got {_checks.show(origin)}")
    if negate not in (0, 1) or isinstance(negate, float):
        raise ValueError(f"{file}: negate: must be 0 or 1, got {_checks.show(negate)}")
    if not isinstance(mode, str) or mode.lower() not in ("trinary", "scale", "raw"):
        raise ValueError(f"{file}: mode: must be 'trinary', 'scale' or 'raw', got {_checks.show(mode)}")
    free = _number(file, "free_thresh", data["free_thresh"], low=0, high=1)
    occupied = _number(file, "occupied_thresh", data["occupied_thresh"], low=0, high=1)
    if free >= occupied:
        raise ValueError(f"{file}: occupied_thresh: must be > free_thresh = {free}, got {occupied}")
    return _MapYaml(
        image=_checks.existing_file(file.parent / image),
        resolution=_number(file, "resolution", data["resolution"], above=0),
        origin=[_number(file, f"origin[{i}]", value) for i, value in enumerate(origin)],
        negate=bool(negate),
        occupied_thresh=occupied,
        free_thresh=free,
        mode=mode.lower(),
    )


def _number(file: Path, key: str, value: object, **limits: float) -> float:
    # 5e-2 is a number to YAML 1.2 and to map_server, but a string to YAML 1.1 and to PyYAML.
    if isinstance(value, str) and re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+", value):
        value = float(value)
    try:
        return _checks.real(f"{file}: {key}", value, **limits)
    except TypeError as error:
        raise ValueError(str(error)) from None


def _cell_table(meta: _MapYaml, white: int) -> NDArray[np.int8]:
    """The cell for every sum of channels from 0 to ``white``, by nav2's rules in float64."""
    shade = np.arange(white + 1, dtype=np.float64)
    if meta.mode == "raw":
        value = np.floor(shade * 255 / white + 0.5)
        return np.where(value <= 100, value, -1).astype(np.int8)
    p = (shade if meta.negate else white - shade) / white
    cells = np.full(p.shape, -1.0)
    if meta.mode == "scale":
        ratio = (p - meta.free_thresh) / (meta.occupied_thresh - meta.free_thresh)
        cells = np.floor(100 * ratio + 0.5)
    cells[p >= meta.occupied_thresh] = 100
    cells[p <= meta.free_thresh] = 0
    return cells.astype(np.int8)


def _open_raster(stream: BinaryIO, file: Path, size: int) -> _Raster:
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
    """The first and last-plus-one row of every strip."""
    height = max(1, _STRIP_CELLS // cols)
    return ((top, min(rows, top + height)) for top in range(0, rows, height))


def _open_pnm(stream: BinaryIO, file: Path, size: int) -> _Raster:
    """A PGM or PPM image, plain (P2, P3) or raw (P5, P6), as the netpbm manual pages define them."""
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
            yield _channel_sum(block.reshape(end - top, cols, channels)), None

    return _Raster(rows, cols, channels * maxval, strips())


def _pnm_header(stream: BinaryIO, file: Path) -> list[int]:
    """The three numbers after the magic; the stream is left at the first byte of the raster."""
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
    """The first ``count`` decimal numbers of the stream."""
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
    """Turn what a broken image makes Pillow, zlib or struct raise into a ValueError."""
    try:
        yield
    except (OSError, SyntaxError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise ValueError(f"{file}: must be a whole {kind} image, got a broken one: {error}") from error


def _check_png(stream: BinaryIO) -> None:
    """See that the image data of a PNG inflates to what its header claims, in little memory.

    Pillow allocates by the header, and leaves black what is missing: walls that are not there.
    """
    cols, rows, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", stream.read(29)[16:])
    bits = depth * {2: 3, 4: 2, 6: 4}.get(colour, 1)
    # The passes of Adam7: first column and row, step along the columns and along the rows.
    adam7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    claimed = 0
    for x, y, dx, dy in adam7 if interlace else ((0, 0, 1, 1),):
        width, height = -((x - cols) // dx), -((y - rows) // dy)
        if width > 0:
            claimed += max(height, 0) * (1 + (width * bits + 7) // 8)
    inflater = zlib.decompressobj()
    found = 0
    for piece in _png_data(stream):
        while piece and found <= claimed:
            found += len(inflater.decompress(piece, 1 << 20))
            piece = inflater.unconsumed_tail
        if inflater.eof or found > claimed:
            break
    else:
        found += len(inflater.flush())
    if found < claimed or (found == claimed and not inflater.eof):
        raise ValueError(f"its data inflates to {found} of {claimed} bytes")


def _png_data(stream: BinaryIO) -> Iterator[bytes]:
    """The contents of a PNG's IDAT chunks, piece by piece; the stream is inside the first chunk, IHDR."""
    stream.seek(33)
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


def _open_pillow(stream: BinaryIO, file: Path, size: int, kind: str) -> _Raster:
    """A PNG or BMP image through Pillow."""
    from PIL.BmpImagePlugin import BmpImageFile
    from PIL.PngImagePlugin import PngImageFile

    # Not through Image.open, whose limit on pixels is a setting of the whole process and below our maps.
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

    transparent = image.info.get("transparency")
    mode = {"1": "L", "P": "RGB"}.get(image.mode, image.mode)
    if transparent is not None:
        mode = {"L": "LA", "RGB": "RGBA"}.get(mode, mode)
    deep = mode.startswith("I")  # 16 bits of grey
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
            yield _channel_sum(values[:, :, :colours]), opaque

    return _Raster(rows, cols, 65535 if deep else 255 * colours, strips())


def _channel_sum(values: NDArray[Any]) -> NDArray[np.uint32]:
    """(h, w, C) channels to their sum (h, w)."""
    total: NDArray[np.uint32] = values[:, :, 0].astype(np.uint32)
    for channel in range(1, values.shape[2]):
        total += values[:, :, channel]
    return total
