"""Read and write maps of ROS map_server (a YAML file and a PGM, PNG or BMP image), and read maps of BeeSoft."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.documents import read_mapping
from gpusense._util.files import write_several
from gpusense._util.lines import number_in, numbered_lines, numbers_in
from gpusense._util.memory import check_room
from gpusense.world.grid import FARTHEST_ORIGIN, LARGEST_RESOLUTION, SMALLEST_RESOLUTION, OccupancyGrid, grid_of_checked
from gpusense.world.images import MODES, UNKNOWN_GREY, MapMode, mapped, open_raster, paint, write_image

_ENDINGS = (".pgm", ".ppm", ".pnm", ".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff")


class _MapYaml(NamedTuple):
    image: Path
    resolution: float
    origin: ArrayLike
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: str


def read_map(path: str | os.PathLike[str], *, occupied_threshold: int = 65) -> OccupancyGrid:
    """Read a map of ROS map_server, or a text map of BeeSoft (``wean.dat``).

    Cells equal those that nav2_map_server 1.4 to 1.5 reads (``map_io.cpp``), which computes in float32; earlier
    versions took the mean of the channels in float64. Let g be the grey of a pixel, 0 to 255: its value, or the luma
    0.299 R + 0.587 G + 0.114 B of a colour. The occupancy is p = 1 - g / 255, or g / 255 with ``negate``.

    - Modes ``trinary`` (the default) and ``scale``: p >= ``occupied_thresh`` is 100, and p <= ``free_thresh`` is 0.
      Values between them are unknown in mode trinary, and in mode scale
      ``round(100 (p - free_thresh) / (occupied_thresh - free_thresh))``. A pixel that is not opaque is unknown.
    - Mode ``raw``: g, unknown if that exceeds 100.

    Numbers of the YAML file are decimal, as nav2 reads them: 010 is ten, and 1:30 is refused. They may be quoted. A
    doubled key is refused.

    The image's bottom row is ``cells[0]``. The content of the image determines its format: PGM (P2, P5; 8 or 16 bits),
    PPM (P3, P6), PNG (1 to 16 bits; grey, palette or colour, with or without alpha) or uncompressed BMP. Of a 16-bit
    value the grey keeps the upper 8 bits of its fraction of white. Three images differ from nav2's: a 16-bit PNG with
    colours or alpha counts with its upper 8 bits only, the transparent colour of an 8-bit RGB PNG is unknown, and a PGM
    may have any maximum. Memory is allocated only after two checks: the file holds the pixels that its header claims
    (at most 2^29), and enough memory is free. A cell takes a byte; PNG and BMP take one more for each grey pixel, two
    with 16 bits, or four in colour.

    A file ``.dat`` or ``.dat.gz`` has a line for each x with the probabilities that the cells are free, or -1 for
    unknown, and possibly a header with the resolution, else 0.1 m; its cells are ``round(100 (1 - p))``.

    Args:
        path: The YAML file; the path of ``image`` in it is relative to its folder. Or a file ``.dat`` or ``.dat.gz``.
        occupied_threshold: Least occupancy of an occupied cell, as in :class:`OccupancyGrid` [per cent].

    Raises:
        FileNotFoundError: The YAML file or its image is missing.
        TypeError: ``path`` or ``occupied_threshold`` has the wrong type.
        ValueError: A file breaks the format; the message names the file and the rule.
        MemoryError: The map does not fit into the available memory.

    Warns:
        UserWarning: A map of mode trinary has the grey 205 of unknown cells, and its ``free_thresh`` makes them free.

    Example:
        >>> import gpusense as gs, pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "map.yaml")
        ...     gs.write_map(gs.OccupancyGrid([[0, 100], [-1, 0]], resolution=0.1), path)
        ...     gs.read_map(path).cells.tolist()
        [[0, 100], [-1, 0]]
    """
    file = checks.existing_file(checks.path("path", path))
    if file.name.lower().endswith((".dat", ".dat.gz")):
        return _read_probabilities(file, occupied_threshold=occupied_threshold)
    _check_no_image(file)
    meta = _read_yaml(file)
    checks.integer("occupied_threshold", occupied_threshold, low=1, high=100)
    size = meta.image.stat().st_size
    with meta.image.open("rb") as stream:
        raster = open_raster(stream, meta.image, size)
        table = _cell_table(meta)
        cells = np.empty((raster.rows, raster.cols), np.int8)
        end, freed = raster.rows, 0
        # True if the grey of map_saver's unknown cells is free.
        frees = meta.mode == "trinary" and not meta.negate and table[UNKNOWN_GREY] == 0
        for greys, opaque in raster.strips:
            block = cells[end - len(greys) : end][::-1]
            block[:] = mapped(greys, table)
            if opaque is not None and meta.mode != "raw":
                block[~opaque] = -1
            if frees:
                freed += int(np.count_nonzero((greys == UNKNOWN_GREY) & (block == 0)))
            end -= len(block)
    if freed:
        warnings.warn(
            f"{file}: free_thresh: must be < {1 - UNKNOWN_GREY / 255:.6f} for cells of grey {UNKNOWN_GREY} to be "
            f"unknown, got {meta.free_thresh}: {freed} such cells are free",
            stacklevel=2,
        )
    return grid_of_checked(cells, meta.resolution, meta.origin, occupied_threshold=occupied_threshold)


def write_map(
    grid: OccupancyGrid,
    path: str | os.PathLike[str],
    *,
    image_format: Literal["pgm", "png"] = "pgm",
    mode: MapMode | None = None,
) -> None:
    """Write a map for ROS map_server, atomically.

    The image has the YAML file's name with the suffix of its format. Modes:

    - ``"trinary"``: map_saver's greys, 254 for free, 0 for occupied, 205 for unknown cells (``free_thresh`` 0.196). The
      image can be viewed and edited. :func:`read_map` returns the same free, occupied and unknown cells, of 0, 100
      and -1.
    - ``"scale"``: from white, 0 per cent, to black; unknown cells are transparent, which requires a PNG. Cells are read
      back unchanged.
    - ``"raw"``: per cent as greys, which look almost black, and 255 for unknown. Cells are read back unchanged.
    - None: trinary for a grid of 0, 100 and unknown, else raw, so that cells are read back unchanged.

    The format does not store ``occupied_threshold``, which decides between free and occupied in mode trinary.

    Args:
        grid: The map.
        path: The YAML file, ending in .yaml or .yml. It and its image are replaced if they exist.
        image_format: ``"pgm"`` or ``"png"``.
        mode: The mode.

    Raises:
        FileNotFoundError: The folder is missing.
        TypeError: An argument has the wrong type.
        ValueError: ``path`` has another suffix or is a folder, ``image_format`` or ``mode`` is unknown, or a PGM cannot
            hold the mode's transparent cells.
        OSError: The files cannot be written; the old files are then unchanged.

    Example:
        >>> import gpusense as gs, pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     gs.write_map(gs.OccupancyGrid([[0, 100]]), pathlib.Path(folder, "map.yaml"), image_format="png")
        ...     sorted(file.name for file in pathlib.Path(folder).iterdir())
        ['map.png', 'map.yaml']
    """
    import yaml

    checks.instance("grid", grid, OccupancyGrid)
    target = checks.path("path", path)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"path: must end in .yaml or .yml, got {target}")
    checks.choice("image_format", image_format, ("pgm", "png"))
    if mode is not None:
        checks.choice("mode", mode, MODES)
    image = target.with_suffix(f".{image_format}")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"path: must lie in a folder that exists, got {target}")
    for file in (target, image):
        if file.is_dir():
            raise ValueError(f"path: must not name a folder, got {file}")

    painting = paint(grid, mode)
    if painting.alpha and image_format != "png":
        rule = "must be 'png' for unknown cells in mode 'scale', which are transparent"
        raise ValueError(f"image_format: {rule}, got {image_format!r}")
    meta = {
        "image": image.name,
        "mode": painting.mode,
        "resolution": grid.resolution,
        "origin": list(grid.origin),
        "negate": 0,
        "occupied_thresh": painting.occupied_thresh,
        "free_thresh": painting.free_thresh,
    }
    text = yaml.safe_dump(meta, sort_keys=False, default_flow_style=None, allow_unicode=True)
    writers: dict[Path, Callable[[BinaryIO], object]] = {
        image: lambda stream: write_image(stream, painting, grid.shape, image_format),
        target: lambda stream: stream.write(text.encode()),
    }
    write_several(writers)


def _read_yaml(file: Path) -> _MapYaml:
    if file.suffix in (".bag", ".db3", ".mcap", ".log"):
        other = "a recording is passed by --log or read by gs.read_log"
        raise ValueError(f"{file}: must be the YAML file of a map, got {file.suffix}; {other}")
    data = read_mapping(file)
    for key in ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"):
        if key not in data:
            raise ValueError(f"{file}: must have the key {key!r}, got {checks.show(list(data))}")
    image, origin, negate, mode = data["image"], data["origin"], data["negate"], data.get("mode", "trinary")
    if not isinstance(image, str) or not image or "\0" in image:
        raise ValueError(f"{file}: image: must be a file name, got {checks.show(image)}")
    if not isinstance(origin, list) or len(origin) != 3:
        raise ValueError(f"{file}: origin: must be a list of x, y and yaw, got {checks.show(origin)}")
    negate = {"0": 0, "1": 1, "false": 0, "true": 1}.get(negate, negate) if isinstance(negate, str) else negate
    if negate not in (0, 1) or isinstance(negate, float):
        raise ValueError(f"{file}: negate: must be 0 or 1, got {checks.show(negate)}")
    if not isinstance(mode, str) or mode.lower() not in ("trinary", "scale", "raw"):
        raise ValueError(f"{file}: mode: must be 'trinary', 'scale' or 'raw', got {checks.show(mode)}")
    free = _number(file, "free_thresh", data["free_thresh"], low=0, high=1)
    occupied = _number(file, "occupied_thresh", data["occupied_thresh"], low=0, high=1)
    if free >= occupied:
        raise ValueError(f"{file}: occupied_thresh: must be > free_thresh = {free}, got {occupied}")
    try:
        picture = checks.existing_file(file.parent / image)
    except (FileNotFoundError, ValueError) as error:
        raise type(error)(f"{file}: image: {error}") from None
    resolution = _number(file, "resolution", data["resolution"], low=SMALLEST_RESOLUTION, high=LARGEST_RESOLUTION)
    far = dict(low=-FARTHEST_ORIGIN, high=FARTHEST_ORIGIN)
    limits: tuple[dict[str, float], ...] = (far, far, {})
    pose = [_number(file, f"origin[{i}]", value, **limits[i]) for i, value in enumerate(origin)]
    return _MapYaml(picture, resolution, pose, bool(negate), occupied, free, mode.lower())


def _number(file: Path, key: str, value: object, **limits: float) -> float:
    # map_server reads quoted numbers; it also reads 5e-2, a string in YAML 1.1 and for PyYAML.
    if isinstance(value, str) and re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", value.strip(), re.ASCII):
        value = float(value)
    try:
        return checks.real(f"{file}: {key}", value, **limits)
    except TypeError as error:
        raise ValueError(str(error)) from None


def _cell_table(meta: _MapYaml) -> NDArray[np.int8]:
    """Return the cell for every grey, by nav2's rules: each operation is rounded to float32."""
    greys = np.arange(256)
    if meta.mode == "raw":
        return np.where(greys <= 100, greys, -1).astype(np.int8)
    single = np.float32
    p = greys.astype(single) / single(255)
    p = p if meta.negate else single(1) - p
    free, occupied = single(meta.free_thresh), single(meta.occupied_thresh)
    cells = np.full(p.shape, -1, np.int8)
    cells[p >= occupied] = 100
    cells[p <= free] = 0
    if meta.mode == "scale":
        between = (p > free) & (p < occupied)
        # The difference is rounded once, from float64. Halves are rounded up.
        share = (p[between] - free) / single(meta.occupied_thresh - meta.free_thresh) * single(100)
        cells[between] = np.floor(share.astype(np.float64) + 0.5)
    return cells


def _check_no_image(file: Path) -> None:
    """Refuse an image in place of the YAML file of a map."""
    if file.suffix.lower() not in _ENDINGS:
        return
    beside = [file.with_suffix(suffix) for suffix in (".yaml", ".yml")]
    keys = "image, resolution, origin, negate, occupied_thresh and free_thresh"
    remedies = [f"the YAML file is {one}" for one in beside if one.is_file()]
    remedies.append(f"write {beside[0].name} with {keys}")
    raise ValueError(f"{file}: must be the YAML file of a map, got an image: {remedies[0]}")


_MOST_CELLS = 1 << 28
_SPECIFICATION, _SIZE = b"robot_specifications->", b"global_map[0]:"


def _read_probabilities(file: Path, *, occupied_threshold: int) -> OccupancyGrid:
    """Read a map of BeeSoft; cells are ``round(100 (1 - p))``, p the probability of being free."""
    resolution, columns = 0.1, list[NDArray[np.int8]]()
    for number, line in numbered_lines(file):
        where, fields = f"{file}:{number}", line.split()
        if not fields or line.lstrip().startswith(_SIZE):
            continue
        if fields[0].startswith(_SPECIFICATION):
            if fields[0] == _SPECIFICATION + b"resolution":
                resolution = number_in(fields[1]) / 100 if len(fields) == 2 else 0.0
                if not SMALLEST_RESOLUTION <= resolution <= LARGEST_RESOLUTION:
                    rule = f"a number of centimetres, {100 * SMALLEST_RESOLUTION:g} to {100 * LARGEST_RESOLUTION:g}"
                    raise ValueError(f"{where}: resolution: must be {rule}, got {fields[1:3]}")
            continue
        free = numbers_in(where, fields, lambda index: f"number {index + 1} in a line of probabilities")
        wrong = ~((free >= 0) & (free <= 1) | (free == -1))
        if wrong.any():
            got = checks.show(free[wrong][0])
            raise ValueError(f"{where}: must be probabilities, 0 to 1, or -1 for unknown, got {got}")
        columns.append(np.where(free < 0, -1, np.round(100 * (1 - free))).astype(np.int8))
        if len(free) != len(columns[0]):
            raise ValueError(f"{where}: must have {len(columns[0])} numbers, as line 1, got {len(free)}")
        if len(columns) * len(free) > _MOST_CELLS:
            raise ValueError(f"{where}: must have at most {_MOST_CELLS} cells in all, got more")
    if not columns:
        raise ValueError(f"{file}: must have a line of numbers for each x, got none")
    check_room(str(file), len(columns) * len(columns[0]), f"{len(columns[0])} x {len(columns)} cells")
    cells = np.stack(columns, axis=1)
    return grid_of_checked(cells, resolution, (0.0, 0.0, 0.0), occupied_threshold=occupied_threshold)
