"""Bad grids, maps, scanners, parameters and logs are refused with the exact message, and leave no file behind."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpusense.logs import read_log
from gpusense.logs.reader import FORMATS
from gpusense.world.grid import OccupancyGrid
from gpusense.world.map_files import read_map, write_map
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

Action = Callable[[Path], object]


def put(tmp: Path, name: str, content: bytes | str) -> Path:
    """Write one input file."""
    file = tmp / "input" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


GRID = OccupancyGrid([[0, 100]])
V, T = ValueError, TypeError
GRID_CASES = [
    (lambda tmp: OccupancyGrid(np.zeros((0, 5), np.int8)), V, "cells: must hold at least one cell, got shape (0, 5)"),
    (lambda tmp: OccupancyGrid([[0, 100], [-1, 101]]), V,
     "cells: every value must be from -1 to 100, got 101 at index (1, 1)"),
    (lambda tmp: OccupancyGrid([[0.5, 1.0]]), T,
     "cells: must hold integers from -1 to 100, got dtype float64; pass (100 * cells).round().astype(int)"),
]  # fmt: skip


def uniform(**changes: Any) -> Action:
    """Make a uniform scanner with some bad arguments."""
    good = dict(angle_min=0.0, angle_increment=0.1, count=3, range_max=5.0)
    return lambda tmp: Scanner.uniform(**{**good, **changes})


SCANNER_CASES = [
    (lambda tmp: Scanner([], 5.0, 5.0), V, "range_min: must be < range_max = 5.0, got 5.0"),
    (uniform(angle_increment=1e308), V, "angle_increment: must keep every bearing finite, got 1e+308"),
]  # fmt: skip
PARAMETER_CASES = [
    (lambda tmp: BeamParameters(z_hit=0.8), V, "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 1.1"),
    (lambda tmp: BeamParameters().replace(sigma=0.1), V,
     "BeamParameters: every field must be one of z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, "
     "range_bias, sigma_growth, hit, hit_dof, got 'sigma'"),
    (lambda tmp: LikelihoodFieldParameters(z_hit=0.5), V, "z_hit + z_max + z_rand: must be 1 within 1e-06, got 0.6"),
]  # fmt: skip


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
MAP_CASES = [
    (lambda tmp: read_map(tmp / "absent.yaml"), FileNotFoundError, "{tmp}/absent.yaml: must exist, got no such file"),
    (lambda tmp: read_map(tmp), V, "{tmp}: must be a regular file, got another kind"),
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
            (".nan", "must be finite and >= 0.0001 and <= 1000.0, got nan"),
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


GOOD_LINE = "FLASER 3 1.0 2.0 3.0 1 2 3 4 5 6 12.5 robot 0.5"

WEAN_LINE = "L 0 0 0 25 0 0 " + "100 " * 180 + "0.5"


def log_with(*lines: str, name: str = "run.log", **options: Any) -> Action:
    """Read a whole log of these lines."""
    return lambda tmp: list(read_log(put(tmp, name, "".join(f"{line}\n" for line in lines)), **options))


LOG = "{tmp}/input/run.log"
KNOWN = " or ".join(form.name for form in FORMATS)


def bad_lines(message: str, *lines: str, **options: Any) -> tuple[Action, type[Exception], str]:
    """Return the case of a log of these lines that is refused with a message after the log's name."""
    return log_with(*lines, **options), ValueError, LOG + message


LOG_CASES = [
    (lambda tmp: read_log(tmp / "absent.log"), FileNotFoundError, "{tmp}/absent.log: must exist, got no such file"),
    (lambda tmp: read_log(put(tmp, "readme.txt", "").parent), V,
     f"{{tmp}}/input: must be {KNOWN}, got a folder without metadata.yaml, .db3 or .mcap files"),
    (log_with(GOOD_LINE, topic="/scan"), V, "topic: must be left out for a CARMEN log, got '/scan'"),
    (log_with(GOOD_LINE, mount=(0, 0, 0)), V, "mount: must be left out for a CARMEN log, got (0, 0, 0)"),
    (log_with("data", name="run.bag", rear=True), V,
     "rear: must be False for a ROS 1 bag, whose lasers have topics (topic=), got True"),
    bad_lines(":2: must begin with L or O, got 'X'", WEAN_LINE, "X 1 2"),
    bad_lines(":2: O: must have 5 fields, got 3", WEAN_LINE, "O 1 2"),
    bad_lines(":1: O: field 2 must be a finite number, got '1_0'", "O 0 1_0 0 1"),
    bad_lines(":2: L: the laser must stay at (0.25, 0.0, 0.0) on the robot, got (0.5, 0.0, 0.0)", WEAN_LINE,
     WEAN_LINE.replace("25 0 0", "50 0 0")),
    (log_with("O 0 0 0 1", rear=True), V,
     "rear: must be False for a Wean Hall log, whose robot has one laser, got True"),
    bad_lines(": must hold laser or ODOM messages of CARMEN, got none in 2 lines", "hello", "world"),
    bad_lines(":3: FLASER: must have 14 fields, got 10", "# a log", GOOD_LINE, GOOD_LINE[:30]),
    bad_lines(":1: FLASER: field 1 must be a count, got '-3'", GOOD_LINE.replace("FLASER 3", "FLASER -3")),
    bad_lines(f":1: FLASER: field 1 must be a count, got '{'7' * 40}'",
     GOOD_LINE.replace("FLASER 3", f"FLASER {'7' * 1000}")),
    bad_lines(":1: FLASER: field 1 must count at most 12 values, got 1000000000",
     GOOD_LINE.replace("FLASER 3", "FLASER 1000000000")),
    bad_lines(":1: FLASER: must have 13 fields, got 14", GOOD_LINE.replace("FLASER 3", "FLASER 2")),
    bad_lines(":2: FLASER: field 3 must be a number, got '2.O'", GOOD_LINE, GOOD_LINE.replace("2.0", "2.O")),
    bad_lines(":1: a pose must be finite, got (1.0, 2.0, nan)", GOOD_LINE.replace("1 2 3 4", "1 2 nan 4")),
    bad_lines(":1: ODOM: must have 10 fields, got 9", "ODOM 1 2 3 0 0 0 1.0 robot"),
    bad_lines(": must have a reading > 0 unless range_max is given, got none",
     "FLASER 1 0.0 1 2 3 4 5 6 1.0 robot 1.0"),
    bad_lines(":1: ROBOTLASER1: field 10 must count at most 14 values, got 999999999",
     "ROBOTLASER1 0 -1.57 3.14 0.1 80 0.01 0 1 2.5 999999999 1 2 3 4 5 6 0 0 0 0 0 1.0 robot 1.0"),
    bad_lines(":1: range_max: must be finite and > 0, got 0.0",
     "ROBOTLASER1 0 -1.57 3.14 0.1 0 0.01 0 1 2.5 0 1 2 3 4 5 6 0 0 0 0 0 1.0 robot 1.0"),
    (lambda tmp: list(read_log(put(tmp, "run.log", gzip.compress(GOOD_LINE.encode())[:-9]), range_max=5)), V,
     f"{LOG}:1: must be a whole gzip file, got one that is cut off: Compressed file ended before the end-of-stream "
     "marker was reached"),
]  # fmt: skip


CASES = [*GRID_CASES, *MAP_CASES, *SCANNER_CASES, *PARAMETER_CASES, *LOG_CASES]


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(tmp_path, action, kind, message):
    with pytest.raises(kind) as caught:
        action(tmp_path)
    assert type(caught.value) is kind
    assert str(caught.value) == message.replace("{tmp}", str(tmp_path))
    assert {file.name for file in tmp_path.iterdir()} <= {"input"}
    assert not [file for file in tmp_path.rglob("*") if file.name.startswith(".")]
