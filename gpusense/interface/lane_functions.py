"""Functions of scalar OpenCL files, written again for vectors.

A body in lanes may compute the same operations on the same numbers as the scalar one, a vector at a time. It then
reuses the text of the scalar function: a file in ``kernels/opencl/lanes`` says

    // in lanes: STEP two_sum ordered_sum

in place of these functions, structs and macros; they are taken from the scalar file of its name or from a file that it
requires. Numbers become vectors by ``TYPES``; a function or struct ``name`` for which there is a ``name_lanes`` becomes
that one. Numbers in memory, ``global const real *``, stay what they are. A text that serves both chooses by ``?:``,
keeps comparisons as ``long``, and calls functions of numbers alone. Macros are taken as they stand. So are kernels, but
for the names that have a form in lanes: their scalar bodies compute vectors already.
"""

from __future__ import annotations

import functools
import re

from gpusense.interface.signatures import KERNELS

TYPES = {
    "real": "lanes",
    "real2": "LanePair",
    "double": "doubles",
    "double2": "DoublePair",
    "long": "long8",
    "uint": "ulong8",
    "as_double": "as_double8",
    "as_long": "as_long8",
}
_STRUCTS = {"real2", "double2"}
# A real2 that is a sum of two numbers has its high part as x.
_FIELDS = {"x": "hi", "y": "lo"}
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
    """Return a file's text with the functions that it takes from scalar files.

    ``sources``: texts of the scalar file and of the required ones, by name, likewise.
    """
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
    fields = _FIELDS if re.search(r"\breal2?\b", text) else {}
    types = TYPES if numbers else {}

    def word(match: re.Match[str]) -> str:
        dot, found, call = match.groups()
        if dot:
            return dot + fields.get(found, found) + call
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
