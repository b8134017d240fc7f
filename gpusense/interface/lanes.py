"""Flags of kernels in lanes, which compute several particles or beams at once, and in teams, which share an item."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable

from gpusense.interface.signatures import KERNELS, team_of

# By kernel: flags with which it has no body in lanes, and sets of flags of which it requires at least one.
_SCALAR = frozenset({"FLOAT64", "ALL_READINGS", "EXACT_EXPONENT", "CUBES"})
_NEVER: dict[str, frozenset[str]] = {
    "cast_ranges": frozenset(),
    "e_step": _SCALAR - {"FLOAT64"},
    "score_beams": frozenset(),
    "score_field": frozenset({"ALL_READINGS", "SHAPES"}),
    "score_features": _SCALAR | {"LINE"},
}
_NEEDED: dict[str, tuple[set[str], ...]] = dict.fromkeys((
    "cast_ranges", "count_unseen", "draw_particles", "e_step", "fit_lines", "match_scans", "move_particles",
    "place_pair", "place_poses", "score_beacons", "score_beams", "score_contact", "score_field", "score_heading",
    "score_position", "set_weights", "shift_scores", "sum_poses", "weigh_particles",
), (set(),)) | {"field_gradient": ({"LINEAR"},), "score_features": ({"RANGE"}, {"BEARING"})}  # fmt: skip
# By kernel: flags with which its body in lanes computes in float64 where real numbers are float32.
_DOUBLE: dict[str, frozenset[str]] = {"score_field": frozenset({"BILINEAR"})}
# By kernel: flags with which Warp's body has no loops that become vectors, and flags that it requires.
_NO_LOOPS = {
    "score_beams": frozenset({"FLOAT64", "SENSOR_TABLE"}),
    "score_field": frozenset({"ALL_READINGS", "SHAPES"}),
}
_IN_LOOPS: dict[str, frozenset[str]] = {"score_beams": frozenset(), "score_field": frozenset({"BILINEAR"})}
# Flags of teams, the largest first.
_TEAMS = (frozenset({"IN_TEAMS"}), frozenset({"IN_TEAMS", "SMALL_TEAMS"}))


def with_lanes_flag(
    lanes: int, kernel: str, flags: frozenset[str] | set[str], *, float64: bool = True
) -> frozenset[str]:
    """Return the flags of a launch, with IN_LANES where device and kernel compute in lanes, some with float64."""
    return _flagged(lanes, kernel, frozenset(flags), float64)


@functools.lru_cache(maxsize=256)
def _flagged(lanes: int, kernel: str, flags: frozenset[str], float64: bool) -> frozenset[str]:
    """See ``with_lanes_flag``; calls repeat the flags of earlier ones."""
    never = _NEVER.get(kernel, _SCALAR)
    if not float64 and kernel in _DOUBLE and _DOUBLE[kernel] <= flags:
        return flags
    if lanes == 1 or flags & never or not any(needed <= flags for needed in _NEEDED.get(kernel, ())):
        return flags
    return flags | {"IN_LANES"}


def with_loops_flag(vector_loops: bool, kernel: str, flags: frozenset[str]) -> frozenset[str]:
    """Return the flags of a launch, with IN_LANES where the compiler makes vectors of loops over readings."""
    if not vector_loops or flags & _NO_LOOPS[kernel] or not _IN_LOOPS[kernel] <= flags:
        return flags
    return flags | {"IN_LANES"}


def with_teams_flags(
    kind: str, kernel: str, flags: frozenset[str], points: int, largest_group: Callable[[str, frozenset[str]], int]
) -> tuple[frozenset[str], int]:
    """Return the flags of a launch, including flags of teams on a GPU, and the work-items of an item.

    A team is the smallest with a work-item for every two points, or the largest that the device holds.
    """
    if kind != "gpu":
        return flags, 1
    teams = [(team_of(KERNELS[kernel], flags | more), flags | more) for more in _TEAMS]
    enough = sum(2 * team >= points for team, _ in teams)
    for team, shared in teams[max(enough - 1, 0) :]:
        if team <= largest_group(kernel, shared):
            return shared, team
    return flags, 1


# ---- functions of scalar OpenCL files, written again for vectors
#
# A file in ``kernels/opencl/lanes`` says ``// in lanes: STEP two_sum ordered_sum`` in place of these functions, structs
# and macros; they are taken from the scalar file of its name or from a file that it requires. Numbers become vectors by
# ``TYPES``; a function or struct ``name`` for which there is a ``name_lanes`` becomes that one. Numbers in memory stay
# what they are. A text for numbers and vectors chooses by ``?:`` and calls functions of numbers alone. It stores
# comparisons of ``real`` as ``integer``, and of ``double`` as ``long``. Macros and kernels are taken as they stand.


TYPES = {
    "real": "lanes",
    "real2": "LanePair",
    "real4": "LaneQuad",
    "integer": "ilanes",
    "double": "doubles",
    "double2": "DoublePair",
    "long": "long8",
    "uint": "ulong8",
    "as_double": "as_double8",
    "as_long": "as_long8",
}
_STRUCTS = {"real2", "real4", "double2"}
_WANTED = re.compile(r"^// in lanes: (.*)\n", re.MULTILINE)
_DEFINED = re.compile(r"^\w[\w* ]*?[ *](\w+_lanes)[(;]", re.MULTILINE)
# Lists the functions and types in lanes that a text defines.
_names_in_lanes = functools.lru_cache(maxsize=512)(_DEFINED.findall)
_DEFINITION = re.compile(
    r"^(?:#define (?P<macro>\w+) [^\n]*|typedef struct \{[^}]*\} (?P<struct>\w+);"
    r"|(?:\w+ )+(?P<function>\w+)\([^;{}]*\) \{(?:[^\n]*\}$|.*?^\}))",
    re.MULTILINE | re.DOTALL,
)
_MEMORY = re.compile(r"\b(?:global|constant) (?:const )?\w+ \*")
_WORD = re.compile(r"([.]?)\b([A-Za-z_]\w*)(\(?)")


def takes_scalar_text(text: str) -> bool:
    """Return whether a file in lanes takes functions from scalar files."""
    return _WANTED.search(text) is not None


def written_in_lanes(text: str, file: str, sources: dict[str, str]) -> str:
    """Return a file's text with the functions that it takes from scalar ``sources``, the texts of files by name."""
    if not takes_scalar_text(text):
        return text
    known = {name for each in (*sources.values(), text) for name in _names_in_lanes(each)}

    def definitions(match: re.Match[str]) -> str:
        line = text.count("\n", 0, match.start()) + 1
        names = match.group(1).split()
        known.update(f"{name}_lanes" for name in names if not name.isupper() and name not in KERNELS)
        written = "".join(_written(name, file, sources, known) for name in names)
        return f'{written}#line {line + 1} "{file}.cl"\n'

    return _WANTED.sub(definitions, text)


@functools.lru_cache(maxsize=512)
def _definitions(text: str) -> dict[str, tuple[int, str]]:
    """Return the macros, structs and functions that a text defines, by name: line and definition of each."""
    found: dict[str, tuple[int, str]] = {}
    for match in _DEFINITION.finditer(text):
        name = match["macro"] or match["struct"] or match["function"]
        found.setdefault(name, (text.count("\n", 0, match.start()) + 1, match.group()))
    return found


def _written(name: str, file: str, sources: dict[str, str], known: set[str]) -> str:
    """Return one definition in lanes, with its place in the scalar file."""
    for source, text in sources.items():
        if name in (definitions := _definitions(text)):
            line, definition = definitions[name]
            if not name.isupper():
                replaced = frozenset(word for word in _words(definition) if f"{word}_lanes" in known)
                definition = _vectors(definition, replaced, name not in KERNELS)
            return f'#line {line} "{source}.cl"\n{definition}\n'
    raise ValueError(f"{file}.cl: what it takes in lanes must stand in a scalar file, got {name!r}")


@functools.lru_cache(maxsize=512)
def _words(text: str) -> frozenset[str]:
    return frozenset(match[2] for match in _WORD.finditer(text))


@functools.lru_cache(maxsize=512)
def _vectors(text: str, replaced: frozenset[str], numbers: bool) -> str:
    """Return a definition with vectors for ``numbers``, and with the forms in lanes of the names in ``replaced``."""
    types = TYPES if numbers else {}

    def word(match: re.Match[str]) -> str:
        dot, found, call = match.groups()
        if dot:
            return match[0]
        # Structs have capitals; a variable may have the name of a function.
        is_replaced = found in replaced and (call or found[0].isupper())
        return (f"{found}_lanes" if is_replaced else types.get(found, found)) + call

    kept = _MEMORY.findall(text)
    pieces = [_WORD.sub(word, piece) for piece in _MEMORY.split(_braced(text))]
    return "".join(piece + memory for piece, memory in zip(pieces, [*kept, ""], strict=True))


def _braced(text: str) -> str:
    """Return a text in which ``(real2)(a, b)`` is ``(real2){a, b}``, the form for structs."""
    for name in _STRUCTS:
        begin = text.find(f"({name})(")
        while begin >= 0:
            opened = begin + len(name) + 2
            end, depth = opened, 0
            while True:
                depth += {"(": 1, ")": -1}.get(text[end], 0)
                if depth == 0:
                    break
                end += 1
            text = f"{text[:opened]}{{{text[opened + 1 : end]}}}{text[end + 1 :]}"
            begin = text.find(f"({name})(")
    return text
