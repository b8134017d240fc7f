"""Bad map files, and maps that cannot be written, with the exact message of each."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from support.bad_input_files import Action, put
from support.bad_input_grid import GRID

from gpusense.world.map_files import read_map, write_map

GOOD_YAML = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[0, 0, 0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}
GOOD_PGM = b"P5 2 1 255\n\x00\xfe"


def map_with(content: bytes = GOOD_PGM, name: str = "map.pgm", drop: str = "", **changes: str) -> Action:
    """Read a map whose image or YAML entries differ from a good one's."""

    def action(tmp: Path) -> object:
        put(tmp, name, content)
        meta = {**GOOD_YAML, "image": name, **changes}
        return read_map(put(tmp, "map.yaml", "".join(f"{k}: {v}\n" for k, v in meta.items() if k != drop)))

    return action


def yaml_with(text: str | bytes) -> Action:
    """Read a map whose YAML file has this text."""
    return lambda tmp: read_map(put(tmp, "map.yaml", text))


def png(cols: int, rows: int, raster: bytes, depth: int = 8) -> bytes:
    """Return a grey PNG file that claims a size, with image data of any length."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", cols, rows, depth, 0, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raster)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def bmp(cols: int, rows: int, compression: int = 0, raster: bytes = b"") -> bytes:
    """Return a BMP file of 24 bits that claims a size."""
    info = struct.pack("<IiiHHIIiiII", 40, cols, rows, 1, 24, compression, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54 + len(raster), 0, 0, 54) + info + raster


YAML = "{tmp}/input/map.yaml"
PGM = "{tmp}/input/map.pgm"
V, T = ValueError, TypeError
MAP_CASES = [
    (lambda tmp: read_map(tmp / "absent.yaml"), FileNotFoundError, "{tmp}/absent.yaml: must exist, got no such file"),
    (lambda tmp: read_map(tmp), V, "{tmp}: must be a regular file, got another kind"),
    (lambda tmp: read_map(3), T, "path: must be a path, got 3"),
    (map_with(image="absent.pgm"), FileNotFoundError,
     f"{YAML}: image: {{tmp}}/input/absent.pgm: must exist, got no such file"),
    (map_with(image="a" * 300), FileNotFoundError,
     f"{YAML}: image: {{tmp}}/input/" + "a" * 300 + ": must exist, got no such file"),
    (map_with(image="3"), V, f"{YAML}: image: must be a file name, got 3"),
    *[
        (map_with(drop=key), V, f"{YAML}: must have the key {key!r}, got {[k for k in GOOD_YAML if k != key]}")
        for key in GOOD_YAML
    ],
    (yaml_with(""), V, f"{YAML}: must hold a YAML mapping, got None"),
    (yaml_with("image: !!python/object/apply:os.getcwd []\n"), V,
     f"{YAML}: must be plain YAML, got an error in line 1: could not determine a constructor for the tag "
     "'tag:yaml.org,2002:python/object/apply:os.getcwd'"),
    (yaml_with(b"\x00\x01\x02"), V, f"{YAML}: must be plain YAML, got an error: control characters are not allowed"),
    (yaml_with("[" * 5_000), V,
     f"{YAML}: must be plain YAML, got an error: its parts must be nested at most 100 deep, got more"),
    (yaml_with(b"#" * (1 << 20) + b"\n"), V,
     f"{YAML}: must be a YAML file of at most 1048576 bytes, got a larger file"),
    *[
        (map_with(resolution=text), V, f"{YAML}: resolution: {message}")
        for text, message in [
            ("5e-5", "must be finite and >= 0.0001 and <= 1000.0, got 5e-05"),
            ("5000", "must be finite and >= 0.0001 and <= 1000.0, got 5000"),
            (".nan", "must be finite and >= 0.0001 and <= 1000.0, got nan"),
            ("true", "must be a real number, got True"),
            ("'0.05 m'", "must be a real number, got '0.05 m'"),
        ]
    ],
    (map_with(origin="[0, 0]"), V, f"{YAML}: origin: must be a list of x, y and yaw, got [0, 0]"),
    (map_with(origin="[0, 1e17, 0]"), V,
     f"{YAML}: origin[1]: must be finite and >= -1000000000.0 and <= 1000000000.0, got 1e+17"),
    (map_with(negate="2"), V, f"{YAML}: negate: must be 0 or 1, got 2"),
    (map_with(occupied_thresh="0.1"), V, f"{YAML}: occupied_thresh: must be > free_thresh = 0.196, got 0.1"),
    (map_with(occupied_thresh="65"), V, f"{YAML}: occupied_thresh: must be finite and >= 0 and <= 1, got 65"),
    (map_with(mode="binary"), V, f"{YAML}: mode: must be 'trinary', 'scale' or 'raw', got 'binary'"),
    (map_with(b"\xff\xd8\xff\xe0JFIF"), V,
     f"{PGM}: must be a PGM, PPM, PNG or BMP image, got a file that begins with b'\\xff\\xd8\\xff\\xe0JFIF'"),
    (map_with(b"P5 2 x 255\n"), V, f"{PGM}: must have a header of width, height and maximum value, got [2]"),
    (map_with(b"P5 2 0 255\n"), V, f"{PGM}: must have 1 to 536870912 pixels, got 0 rows of 2"),
    (map_with(b"P5 2 1 0\n\0\0"), V, f"{PGM}: must have a maximum value of 1 to 65535, got 0"),
    (map_with(b"P5 2 2 255\n\0\0\0"), V, f"{PGM}: must have a raster of at least 4 bytes, got 3"),
    (map_with(b"P5 999999 999999 255\n\0"), V, f"{PGM}: must have 1 to 536870912 pixels, got 999999 rows of 999999"),
    (map_with(b"P5 20000 20000 65535\n\0"), V, f"{PGM}: must have a raster of at least 800000000 bytes, got 1"),
    (map_with(b"P5 2 1 100\n\x64\x65"), V, f"{PGM}: every value must be at most 100, got 101"),
    (map_with(b"P2 2 2 255\n100 100 100"), V, f"{PGM}: must have 4 values, got 3"),
    (map_with(b"P2 2 2 255\n0 zero 0 0"), V, f"{PGM}: must have a raster of decimal numbers, got something else"),
    (map_with(png(20_000, 20_000, b"\0" * 100), "map.png"), V,
     "{tmp}/input/map.png: must be a whole PNG image, got a broken one: its data inflates to 100 of 400020000 bytes"),
    (map_with(png(40_000, 40_000, b"\0" * 100, depth=1), "map.png"), V,
     "{tmp}/input/map.png: must have 1 to 536870912 pixels, got 40000 rows of 40000"),
    (map_with(png(2, 2, b"\0" * 5), "map.png"), V,
     "{tmp}/input/map.png: must be a whole PNG image, got a broken one: its data inflates to 5 of 6 bytes"),
    (map_with(bmp(20_000, 20_000), "map.bmp"), V, "{tmp}/input/map.bmp: must have at least 1200000054 bytes, got 54"),
    (lambda tmp: write_map([[0]], tmp / "copy.yaml"), T, "grid: must be an OccupancyGrid, got [[0]]"),
    (lambda tmp: write_map(GRID, tmp / "copy.pgm"), V, "path: must end in .yaml or .yml, got {tmp}/copy.pgm"),
    (lambda tmp: write_map(GRID, tmp / "copy.yaml", image_format="jpg"), V,
     "image_format: must be one of 'pgm', 'png', got 'jpg'"),
    (lambda tmp: write_map(GRID, tmp / "absent" / "copy.yaml"), FileNotFoundError,
     "path: must lie in a folder that exists, got {tmp}/absent/copy.yaml"),
    (lambda tmp: write_map(GRID, put(tmp, "copy.yaml/file", "").parent), V,
     "path: must not name a folder, got {tmp}/input/copy.yaml"),
]  # fmt: skip
