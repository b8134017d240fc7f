"""The registry of casters: kernels, tables, tests and reports iterate over its entries."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CasterEntry:
    """A caster as host and kernels know it."""

    name: str  # its name for users
    file: str  # the kernel file with its ``cast_ray``; the name is the same in OpenCL, Warp and NumPy
    flag: str = ""  # the flag that selects it in kernels; empty for the exact caster
    code: str = ""  # the meaning of the flag


# The caster's class, with its knobs, error and memory, is in gpusense/tables/casters.py.
ENTRIES = {
    entry.name: entry
    for entry in (
        CasterEntry("exact", "raycast"),
        CasterEntry("dda", "dda", "DDA", "rays are cast cell by cell"),
        CasterEntry("march", "march", "MARCH", "rays are cast by marching through the distance field"),
        CasterEntry("bresenham", "bresenham", "BRESENHAM", "rays are cast along Bresenham's lines"),
        CasterEntry("cddt", "cddt", "CDDT", "rays are cast through a compressed directional distance transform"),
        CasterEntry("lookup", "lookup", "LOOKUP", "ranges come from a look-up table"),
    )
}
FLAGS = {entry.flag: entry.code for entry in ENTRIES.values() if entry.flag}


def caster_file(flags: frozenset[str]) -> str:
    """Return the kernel file of the caster of a set of flags."""
    return next((entry.file for entry in ENTRIES.values() if entry.flag in flags), ENTRIES["exact"].file)
