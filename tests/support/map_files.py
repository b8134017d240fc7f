"""Map files for tests: their YAML, and images byte by byte."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import yaml

# Top row first, as in the image: occupied, unknown / free, occupied by one grey level.
GREYS = np.array([[0, 205], [254, 89]], np.uint8)
CELLS = [[0, 100], [100, -1]]


def yaml_text(image="map.pgm", **changes):
    meta = dict(image=image, resolution=0.05, origin=[0, 0, 0], negate=0, occupied_thresh=0.65, free_thresh=0.196)
    return yaml.safe_dump({**meta, **changes})


def pgm(greys, maxval=255):
    greys = np.asarray(greys)
    width = ">u1" if maxval < 256 else ">u2"
    return b"P5\n%d %d\n%d\n" % (*greys.shape[::-1], maxval) + greys.astype(width).tobytes()


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(cols, rows, raster, depth=8, colour=0, before=b""):
    """Return a PNG file with the given bytes for its image data, filter bytes included."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", cols, rows, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + before + chunk(b"IDAT", zlib.compress(raster)) + chunk(b"IEND", b"")
