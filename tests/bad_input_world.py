"""Bad input to the map, the scanner, the parameters and the logs, with the exact message of each.

``CASES`` holds (id, action, exception type, message). The action takes an empty folder; the files that it reads
it first writes to ``input`` in there, so anything outside ``input`` was left behind by the library. ``{tmp}`` in
a message stands for the folder.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gpusense.grid import OccupancyGrid
from gpusense.logs import read_log
from gpusense.map_io import read_map, write_map
from gpusense.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.scanner import Scanner, classify

Action = Callable[[Path], object]

GRID = OccupancyGrid([[0, 100]])
SCANNER = Scanner([0.0, 0.1, 0.2], 5.0, 0.1)
GOOD_YAML = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[0, 0, 0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}
GOOD_PGM = b"P5 2 1 255\n\x00\xfe"
GOOD_LINE = "FLASER 3 1.0 2.0 3.0 1 2 3 4 5 6 12.5 robot 0.5"


def put(tmp: Path, name: str, content: bytes | str) -> Path:
    """Write one input file."""
    file = tmp / "input" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def map_with(content: bytes = GOOD_PGM, name: str = "map.pgm", drop: str = "", **changes: str) -> Action:
    """Read a map of which the image or some YAML entries differ from a good one."""

    def action(tmp: Path) -> object:
        put(tmp, name, content)
        meta = {**GOOD_YAML, "image": name, **changes}
        return read_map(put(tmp, "map.yaml", "".join(f"{k}: {v}\n" for k, v in meta.items() if k != drop)))

    return action


def yaml_with(text: str | bytes) -> Action:
    """Read a map whose YAML file has this text."""
    return lambda tmp: read_map(put(tmp, "map.yaml", text))


def log_with(*lines: str, name: str = "run.log", **options: Any) -> Action:
    """Read a whole log of these lines."""
    return lambda tmp: list(read_log(put(tmp, name, "\n".join(lines)), **options))


def png(cols: int, rows: int, raster: bytes) -> bytes:
    """A grey PNG file that claims a size, with image data of any length."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", cols, rows, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raster)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def bmp(cols: int, rows: int, compression: int = 0, raster: bytes = b"") -> bytes:
    """A BMP file of 24 bits that claims a size."""
    info = struct.pack("<IiiHHIIiiII", 40, cols, rows, 1, 24, compression, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54 + len(raster), 0, 0, 54) + info + raster


def uniform(**changes: Any) -> Action:
    """A uniform scanner of which some arguments are bad."""
    good = dict(angle_min=0.0, angle_increment=0.1, count=3, range_max=5.0)
    return lambda tmp: Scanner.uniform(**{**good, **changes})


GRID_CASES = [
    ("grid-1d", lambda tmp: OccupancyGrid([0, 1]), ValueError, "cells: shape must be (H, W), got (2,)"),
    (
        "grid-no-rows",
        lambda tmp: OccupancyGrid(np.zeros((0, 5), np.int8)),
        ValueError,
        "cells: must hold at least one cell, got shape (0, 5)",
    ),
    (
        "grid-101",
        lambda tmp: OccupancyGrid([[0, 100], [-1, 101]]),
        ValueError,
        "cells: every value must be from -1 to 100, got 101 at index (1, 1)",
    ),
    (
        "grid-minus-2",
        lambda tmp: OccupancyGrid([[0, -2], [200, 0]]),
        ValueError,
        "cells: every value must be from -1 to 100, got -2 at index (0, 1)",
    ),
    (
        "grid-255-of-uint8",
        lambda tmp: OccupancyGrid(np.array([[255]], np.uint8)),
        ValueError,
        "cells: every value must be from -1 to 100, got 255 at index (0, 0)",
    ),
    (
        "grid-float",
        lambda tmp: OccupancyGrid([[0.5, 1.0]]),
        TypeError,
        "cells: must hold integers, got dtype float64",
    ),
    (
        "grid-bool",
        lambda tmp: OccupancyGrid([[True, False]]),
        TypeError,
        "cells: must hold integers, got dtype bool",
    ),
    ("grid-none", lambda tmp: OccupancyGrid(None), TypeError, "cells: must hold integers, got dtype object"),
    (
        "grid-ragged",
        lambda tmp: OccupancyGrid([[0, 1], [2]]),
        ValueError,
        "cells: must be an array of one shape, got [[0, 1], [2]]",
    ),
    (
        "grid-resolution-0",
        lambda tmp: OccupancyGrid([[0]], 0),
        ValueError,
        "resolution: must be finite and > 0, got 0",
    ),
    (
        "grid-resolution-nan",
        lambda tmp: OccupancyGrid([[0]], float("nan")),
        ValueError,
        "resolution: must be finite and > 0, got nan",
    ),
    (
        "grid-resolution-string",
        lambda tmp: OccupancyGrid([[0]], "0.05"),
        TypeError,
        "resolution: must be a real number, got '0.05'",
    ),
    (
        "grid-resolution-bool",
        lambda tmp: OccupancyGrid([[0]], True),
        TypeError,
        "resolution: must be a real number, got True",
    ),
    (
        "grid-origin-of-two",
        lambda tmp: OccupancyGrid([[0]], 0.05, (1, 2)),
        ValueError,
        "origin: shape must be (3,), got (2,)",
    ),
    (
        "grid-origin-inf",
        lambda tmp: OccupancyGrid([[0]], 0.05, (1, 2, np.inf)),
        ValueError,
        "origin: every value must be finite, got inf at index 2",
    ),
    (
        "grid-threshold-0",
        lambda tmp: OccupancyGrid([[0]], occupied_threshold=0),
        ValueError,
        "occupied_threshold: must be >= 1 and <= 100, got 0",
    ),
    (
        "grid-threshold-fraction",
        lambda tmp: OccupancyGrid([[0]], occupied_threshold=0.65),
        TypeError,
        "occupied_threshold: must be an integer, got 0.65",
    ),
    (
        "grid-points-of-three",
        lambda tmp: GRID.world_to_cells(np.zeros((4, 3))),
        ValueError,
        "xy: shape must be (M, 2), got (4, 3)",
    ),
    (
        "grid-points-nan",
        lambda tmp: GRID.world_to_cells([[0, 0], [1, np.nan]]),
        ValueError,
        "xy: every value must be finite, got nan at index (1, 1)",
    ),
    (
        "grid-points-complex",
        lambda tmp: GRID.world_to_cells([[0, 1j]]),
        TypeError,
        "xy: must hold real numbers, got dtype complex128",
    ),
    (
        "grid-rows-and-cols-differ",
        lambda tmp: GRID.cell_centers([0, 1], [0]),
        ValueError,
        "cols: shape must be (2,), got (1,)",
    ),
    (
        "grid-rows-of-floats",
        lambda tmp: GRID.cell_centers([0.5], [0]),
        TypeError,
        "rows: must hold integers, got dtype float64",
    ),
    (
        "grid-unknown-maybe",
        lambda tmp: GRID.obstacles(unknown="maybe"),
        ValueError,
        "unknown: must be one of 'free', 'occupied', got 'maybe'",
    ),
]

YAML = "{tmp}/input/map.yaml"
PGM = "{tmp}/input/map.pgm"

MAP_CASES = [
    (
        "map-missing-yaml",
        lambda tmp: read_map(tmp / "absent.yaml"),
        FileNotFoundError,
        "{tmp}/absent.yaml: must exist, got no such file",
    ),
    ("map-folder", lambda tmp: read_map(tmp), ValueError, "{tmp}: must be a regular file, got another kind"),
    ("map-path-number", lambda tmp: read_map(3), TypeError, "path: must be a path, got 3"),
    (
        "map-missing-image",
        map_with(image="absent.pgm"),
        FileNotFoundError,
        "{tmp}/input/absent.pgm: must exist, got no such file",
    ),
    (
        "map-impossible-image-name",
        map_with(image="a" * 300),
        FileNotFoundError,
        "{tmp}/input/" + "a" * 300 + ": must exist, got no such file",
    ),
    ("map-image-number", map_with(image="3"), ValueError, f"{YAML}: image: must be a file name, got 3"),
    *[
        (
            f"map-without-{key}",
            map_with(drop=key),
            ValueError,
            f"{YAML}: must have the key {key!r}, got {[k for k in GOOD_YAML if k != key]}",
        )
        for key in GOOD_YAML
    ],
    ("map-empty-yaml", yaml_with(""), ValueError, f"{YAML}: must hold a YAML mapping, got None"),
    ("map-yaml-list", yaml_with("[1, 2]"), ValueError, f"{YAML}: must hold a YAML mapping, got [1, 2]"),
    (
        "map-yaml-tag",
        yaml_with("image: !!python/object/apply:os.getcwd []\n"),
        ValueError,
        f"{YAML}: must be plain YAML, got an error in line 1: could not determine a constructor for the tag "
        "'tag:yaml.org,2002:python/object/apply:os.getcwd'",
    ),
    (
        "map-yaml-binary",
        yaml_with(b"\x00\x01\x02"),
        ValueError,
        f"{YAML}: must be plain YAML, got an error: ReaderError",
    ),
    (
        "map-yaml-deep",
        yaml_with("[" * 5_000),
        ValueError,
        f"{YAML}: must be plain YAML, got an error: RecursionError",
    ),
    (
        "map-yaml-huge",
        yaml_with(b"#" * (1 << 20) + b"\n"),
        ValueError,
        f"{YAML}: must be a YAML file of at most 1048576 bytes, got a larger file",
    ),
    *[
        (f"map-resolution-{name}", map_with(resolution=text), ValueError, f"{YAML}: resolution: {message}")
        for name, text, message in [
            ("0", "0", "must be finite and > 0, got 0"),
            ("negative", "-0.05", "must be finite and > 0, got -0.05"),
            ("nan", ".nan", "must be finite and > 0, got nan"),
            ("bool", "true", "must be a real number, got True"),
            ("string", "'0.05'", "must be a real number, got '0.05'"),
            ("empty", "", "must be a real number, got None"),
        ]
    ],
    (
        "map-origin-of-two",
        map_with(origin="[0, 0]"),
        ValueError,
        f"{YAML}: origin: must be a list of x, y and yaw, got [0, 0]",
    ),
    (
        "map-origin-inf",
        map_with(origin="[0, 0, .inf]"),
        ValueError,
        f"{YAML}: origin[2]: must be finite, got inf",
    ),
    ("map-negate-2", map_with(negate="2"), ValueError, f"{YAML}: negate: must be 0 or 1, got 2"),
    (
        "map-thresholds-out-of-order",
        map_with(occupied_thresh="0.1"),
        ValueError,
        f"{YAML}: occupied_thresh: must be > free_thresh = 0.196, got 0.1",
    ),
    (
        "map-threshold-above-1",
        map_with(occupied_thresh="65"),
        ValueError,
        f"{YAML}: occupied_thresh: must be finite and >= 0 and <= 1, got 65",
    ),
    (
        "map-mode-unknown",
        map_with(mode="binary"),
        ValueError,
        f"{YAML}: mode: must be 'trinary', 'scale' or 'raw', got 'binary'",
    ),
    (
        "map-jpeg",
        map_with(b"\xff\xd8\xff\xe0JFIF"),
        ValueError,
        f"{PGM}: must be a PGM, PPM, PNG or BMP image, got a file that begins with b'\\xff\\xd8\\xff\\xe0JFIF'",
    ),
    (
        "map-empty-image",
        map_with(b""),
        ValueError,
        f"{PGM}: must be a PGM, PPM, PNG or BMP image, got a file that begins with b''",
    ),
    (
        "map-pgm-header",
        map_with(b"P5 2 x 255\n"),
        ValueError,
        f"{PGM}: must have a header of width, height and maximum value, got [2]",
    ),
    (
        "map-pgm-no-rows",
        map_with(b"P5 2 0 255\n"),
        ValueError,
        f"{PGM}: must have 1 to 2147483648 pixels, got 0 rows of 2",
    ),
    (
        "map-pgm-maximum-0",
        map_with(b"P5 2 1 0\n\0\0"),
        ValueError,
        f"{PGM}: must have a maximum value of 1 to 65535, got 0",
    ),
    (
        "map-pgm-truncated",
        map_with(b"P5 2 2 255\n\0\0\0"),
        ValueError,
        f"{PGM}: must have a raster of at least 4 bytes, got 3",
    ),
    (
        "map-pgm-claims-terabytes",
        map_with(b"P5 999999 999999 255\n\0"),
        ValueError,
        f"{PGM}: must have 1 to 2147483648 pixels, got 999999 rows of 999999",
    ),
    (
        "map-pgm-claims-gigabytes",
        map_with(b"P5 40000 40000 65535\n\0"),
        ValueError,
        f"{PGM}: must have a raster of at least 3200000000 bytes, got 1",
    ),
    (
        "map-pgm-above-maximum",
        map_with(b"P5 2 1 100\n\x64\x65"),
        ValueError,
        f"{PGM}: every value must be at most 100, got 101",
    ),
    (
        "map-plain-pgm-short",
        map_with(b"P2 2 2 255\n100 100 100"),
        ValueError,
        f"{PGM}: must have 4 values, got 3",
    ),
    (
        "map-plain-pgm-letters",
        map_with(b"P2 2 2 255\n0 zero 0 0"),
        ValueError,
        f"{PGM}: must have a raster of decimal numbers, got something else",
    ),
    (
        "map-png-claims-gigabytes",
        map_with(png(40_000, 40_000, b"\0" * 100), "map.png"),
        ValueError,
        "{tmp}/input/map.png: must be a whole PNG image, got a broken one: "
        "its data inflates to 100 of 1600040000 bytes",
    ),
    (
        "map-png-one-byte-short",
        map_with(png(2, 2, b"\0" * 5), "map.png"),
        ValueError,
        "{tmp}/input/map.png: must be a whole PNG image, got a broken one: its data inflates to 5 of 6 bytes",
    ),
    (
        "map-bmp-claims-gigabytes",
        map_with(bmp(20_000, 20_000), "map.bmp"),
        ValueError,
        "{tmp}/input/map.bmp: must have at least 1200000054 bytes, got 54",
    ),
    (
        "map-write-no-grid",
        lambda tmp: write_map([[0]], tmp / "copy.yaml"),
        TypeError,
        "grid: must be an OccupancyGrid, got [[0]]",
    ),
    (
        "map-write-suffix",
        lambda tmp: write_map(GRID, tmp / "copy.pgm"),
        ValueError,
        "path: must end in .yaml or .yml, got {tmp}/copy.pgm",
    ),
    (
        "map-write-format",
        lambda tmp: write_map(GRID, tmp / "copy.yaml", image_format="jpg"),
        ValueError,
        "image_format: must be one of 'pgm', 'png', got 'jpg'",
    ),
    (
        "map-write-no-folder",
        lambda tmp: write_map(GRID, tmp / "absent" / "copy.yaml"),
        FileNotFoundError,
        "path: must lie in a folder that exists, got {tmp}/absent/copy.yaml",
    ),
    (
        "map-write-onto-folder",
        lambda tmp: write_map(GRID, put(tmp, "copy.yaml/file", "").parent),
        ValueError,
        "path: must not name a folder, got {tmp}/input/copy.yaml",
    ),
]

SCANNER_CASES = [
    (
        "scanner-bearings-2d",
        lambda tmp: Scanner([[0.0]], 5.0),
        ValueError,
        "bearings: shape must be (K,), got (1, 1)",
    ),
    (
        "scanner-bearings-nan",
        lambda tmp: Scanner([0.0, float("nan")], 5.0),
        ValueError,
        "bearings: every value must be finite, got nan at index 1",
    ),
    (
        "scanner-bearings-words",
        lambda tmp: Scanner(["left"], 5.0),
        TypeError,
        "bearings: must hold real numbers, got dtype <U4",
    ),
    (
        "scanner-range-max-inf",
        lambda tmp: Scanner([0.0], float("inf")),
        ValueError,
        "range_max: must be finite and > 0, got inf",
    ),
    ("scanner-range-max-0", lambda tmp: Scanner([], 0), ValueError, "range_max: must be finite and > 0, got 0"),
    (
        "scanner-range-max-none",
        lambda tmp: Scanner([], None),
        TypeError,
        "range_max: must be a real number, got None",
    ),
    (
        "scanner-range-min-negative",
        lambda tmp: Scanner([], 5.0, -0.1),
        ValueError,
        "range_min: must be finite and >= 0, got -0.1",
    ),
    (
        "scanner-range-min-too-large",
        lambda tmp: Scanner([], 5.0, 5.0),
        ValueError,
        "range_min: must be < range_max = 5.0, got 5.0",
    ),
    (
        "scanner-mount-of-two",
        lambda tmp: Scanner([], 5.0, mount=(0, 0)),
        ValueError,
        "mount: shape must be (3,), got (2,)",
    ),
    ("scanner-count-negative", uniform(count=-1), ValueError, "count: must be >= 0 and <= 2147483647, got -1"),
    ("scanner-count-float", uniform(count=3.0), TypeError, "count: must be an integer, got 3.0"),
    (
        "scanner-count-of-many-digits",
        uniform(count=10**5000),
        ValueError,
        "count: must be >= 0 and <= 2147483647, got a huge int",
    ),
    ("scanner-angle-inf", uniform(angle_min=float("inf")), ValueError, "angle_min: must be finite, got inf"),
    (
        "scanner-angles-overflow",
        uniform(angle_increment=1e308),
        ValueError,
        "angle_increment: must keep every bearing finite, got 1e+308",
    ),
    (
        "classify-length",
        lambda tmp: classify([1.0, 2.0], SCANNER),
        ValueError,
        "ranges: shape must be (3,) or (S, 3), got (2,)",
    ),
    (
        "classify-3d",
        lambda tmp: classify(np.zeros((1, 1, 3)), SCANNER),
        ValueError,
        "ranges: shape must be (3,) or (S, 3), got (1, 1, 3)",
    ),
    (
        "classify-none",
        lambda tmp: classify([1.0, None, 2.0], SCANNER),
        TypeError,
        "ranges: must hold real numbers, got dtype object",
    ),
    (
        "classify-no-scanner",
        lambda tmp: classify([1.0], 5.0),
        TypeError,
        "scanner: must be a Scanner, got 5.0",
    ),
]

PARAMETER_CASES = [
    (
        "beam-weights",
        lambda tmp: BeamParameters(z_hit=0.8),
        ValueError,
        "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 1.1",
    ),
    (
        "beam-weight-negative",
        lambda tmp: BeamParameters(z_hit=1.1, z_short=-0.1, z_max=0, z_rand=0),
        ValueError,
        "z_short: must be finite and >= 0, got -0.1",
    ),
    (
        "beam-weight-nan",
        lambda tmp: BeamParameters(z_rand=float("nan")),
        ValueError,
        "z_rand: must be finite and >= 0, got nan",
    ),
    (
        "beam-sigma-negative",
        lambda tmp: BeamParameters(sigma_hit=-0.1),
        ValueError,
        "sigma_hit: must be finite and > 0, got -0.1",
    ),
    (
        "beam-sigma-0",
        lambda tmp: BeamParameters().replace(sigma_hit=0),
        ValueError,
        "sigma_hit: must be finite and > 0, got 0",
    ),
    (
        "beam-sigma-string",
        lambda tmp: BeamParameters(sigma_hit="0.1"),
        TypeError,
        "sigma_hit: must be a real number, got '0.1'",
    ),
    (
        "beam-lambda-huge",
        lambda tmp: BeamParameters(lambda_short=10**400),
        ValueError,
        f"lambda_short: must be finite and >= 0, got {str(10**400)[:117]}...",
    ),
    (
        "beam-unknown-field",
        lambda tmp: BeamParameters().replace(sigma=0.1),
        ValueError,
        "BeamParameters: every field must be one of z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, "
        "got 'sigma'",
    ),
    (
        "beam-no-mapping",
        lambda tmp: BeamParameters.from_dict([0.7]),
        TypeError,
        "values: must be a mapping, got [0.7]",
    ),
    (
        "field-weights",
        lambda tmp: LikelihoodFieldParameters(z_hit=0.5),
        ValueError,
        "z_hit + z_max + z_rand: must be 1 within 1e-06, got 0.6",
    ),
    (
        "field-distance-inf",
        lambda tmp: LikelihoodFieldParameters(max_distance=float("inf")),
        ValueError,
        "max_distance: must be finite and > 0, got inf",
    ),
    (
        "field-interpolation",
        lambda tmp: LikelihoodFieldParameters(interpolation="cubic"),
        ValueError,
        "interpolation: must be one of 'nearest', 'bilinear', got 'cubic'",
    ),
    (
        "field-interpolation-none",
        lambda tmp: LikelihoodFieldParameters(interpolation=None),
        TypeError,
        "interpolation: must be one of 'nearest', 'bilinear', got None",
    ),
]

LOG = "{tmp}/input/run.log"

LOG_CASES = [
    (
        "log-missing",
        lambda tmp: read_log(tmp / "absent.log"),
        FileNotFoundError,
        "{tmp}/absent.log: must exist, got no such file",
    ),
    *[
        (
            f"log-{suffix}",
            log_with("data", name=f"run.{suffix}"),
            ValueError,
            f"{{tmp}}/input/run.{suffix}: must be a CARMEN log, which is all that this version reads, got {what}",
        )
        for suffix, what in [("bag", "a ROS 1 bag"), ("db3", "a ROS 2 bag"), ("mcap", "an MCAP file")]
    ],
    (
        "log-rosbag2",
        lambda tmp: read_log(put(tmp, "metadata.yaml", "").parent),
        ValueError,
        "{tmp}/input: must be a CARMEN log, which is all that this version reads, got a ROS 2 bag",
    ),
    (
        "log-range-max",
        log_with(GOOD_LINE, range_max=-1),
        ValueError,
        "range_max: must be finite and > 0, got -1",
    ),
    ("log-odometry", log_with(GOOD_LINE, odometry=1), TypeError, "odometry: must be True or False, got 1"),
    (
        "log-other-text",
        log_with("hello", "world"),
        ValueError,
        f"{LOG}: must hold laser or ODOM messages of CARMEN, got none in 2 lines",
    ),
    (
        "log-truncated",
        log_with("# a log", GOOD_LINE, GOOD_LINE[:30]),
        ValueError,
        f"{LOG}:3: FLASER: must have 14 fields, got 10",
    ),
    ("log-no-count", log_with("FLASER"), ValueError, f"{LOG}:1: FLASER: field 1 must be a count, got ''"),
    (
        "log-negative-count",
        log_with(GOOD_LINE.replace("FLASER 3", "FLASER -3")),
        ValueError,
        f"{LOG}:1: FLASER: field 1 must be a count, got '-3'",
    ),
    (
        "log-count-of-a-billion",
        log_with(GOOD_LINE.replace("FLASER 3", "FLASER 1000000000")),
        ValueError,
        f"{LOG}:1: FLASER: field 1 must count at most 12 values, got 1000000000",
    ),
    (
        "log-count-too-small",
        log_with(GOOD_LINE.replace("FLASER 3", "FLASER 2")),
        ValueError,
        f"{LOG}:1: FLASER: must have 13 fields, got 14",
    ),
    (
        "log-range-is-no-number",
        log_with(GOOD_LINE, GOOD_LINE.replace("2.0", "2.O")),
        ValueError,
        f"{LOG}:2: FLASER: field 3 must be a number, got '2.O'",
    ),
    (
        "log-range-with-underscore",
        log_with(GOOD_LINE.replace("2.0", "2_0")),
        ValueError,
        f"{LOG}:1: FLASER: field 3 must be a number, got '2_0'",
    ),
    (
        "log-time-is-no-number",
        log_with(GOOD_LINE.replace("12.5", "noon")),
        ValueError,
        f"{LOG}:1: FLASER: field 11 must be a number, got 'noon'",
    ),
    (
        "log-pose-nan",
        log_with(GOOD_LINE.replace("1 2 3 4", "1 2 nan 4")),
        ValueError,
        f"{LOG}:1: a pose must be finite, got (1.0, 2.0, nan)",
    ),
    (
        "log-odom-short",
        log_with("ODOM 1 2 3 0 0 0 1.0 robot"),
        ValueError,
        f"{LOG}:1: ODOM: must have 10 fields, got 9",
    ),
    (
        "log-no-range-at-all",
        log_with("FLASER 1 0.0 1 2 3 4 5 6 1.0 robot 1.0"),
        ValueError,
        f"{LOG}: must have a reading > 0 unless range_max is given, got none",
    ),
    (
        "log-robotlaser-remissions",
        log_with("ROBOTLASER1 0 -1.57 3.14 0.1 80 0.01 0 1 2.5 999999999 1 2 3 4 5 6 0 0 0 0 0 1.0 robot 1.0"),
        ValueError,
        f"{LOG}:1: ROBOTLASER1: field 10 must count at most 14 values, got 999999999",
    ),
    (
        "log-robotlaser-range-max",
        log_with("ROBOTLASER1 0 -1.57 3.14 0.1 0 0.01 0 1 2.5 0 1 2 3 4 5 6 0 0 0 0 0 1.0 robot 1.0"),
        ValueError,
        f"{LOG}:1: range_max: must be finite and > 0, got 0.0",
    ),
    (
        "log-gzip-truncated",
        lambda tmp: list(read_log(put(tmp, "run.log", gzip.compress(GOOD_LINE.encode())[:-9]), range_max=5)),
        ValueError,
        f"{LOG}:1: must be a whole gzip file, got a broken one: "
        "Compressed file ended before the end-of-stream marker was reached",
    ),
]

CASES: list[tuple[str, Action, type[Exception], str]] = [
    *GRID_CASES,
    *MAP_CASES,
    *SCANNER_CASES,
    *PARAMETER_CASES,
    *LOG_CASES,
]
