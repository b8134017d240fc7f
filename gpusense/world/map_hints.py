"""Find the YAML file that a user meant by naming the map's image."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gpusense._util.documents import read_mapping

_ENDINGS = (".pgm", ".ppm", ".pnm", ".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff")
# YAML files of a folder that are read to find the file of an image.
_MOST = 50


def check_no_image(file: Path) -> None:
    """Refuse an image in place of the YAML file of a map.

    Raises:
        ValueError: The file is an image; the message names the YAML file that belongs to it, if any.
    """
    if file.suffix.lower() not in _ENDINGS:
        return
    found = next(_yaml_files(file), None)
    if found is not None:
        raise ValueError(f"{file}: must be the YAML file of a map, got its image: the YAML file is {found}")
    keys = "image, resolution, origin, negate, occupied_thresh and free_thresh"
    raise ValueError(
        f"{file}: must be the YAML file of a map, got an image, and no YAML file beside it names it: write "
        f"{file.with_suffix('.yaml').name} with {keys}"
    )


def _yaml_files(image: Path) -> Iterator[Path]:
    """Yield the YAML files in an image's folder that name the image, those with the same stem first."""
    named = [image.with_suffix(suffix) for suffix in (".yaml", ".yml")]
    others = sorted(path for path in image.parent.glob("*.y*ml") if path not in named)[:_MOST]
    for path in (*named, *others):
        try:
            name = read_mapping(path).get("image") if path.is_file() else None
        except (ValueError, OSError):
            continue
        if isinstance(name, str) and (path.parent / name).name == image.name and _same(path.parent / name, image):
            yield path


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return False
