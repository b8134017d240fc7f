"""The preprocessor of kernel sources: keep the branches that a set of flags selects.

``#if FLAG``, ``#if !FLAG``, ``#elif``, ``#else`` and ``#endif`` are resolved here, nested as in C. ``#define`` and
``#pragma`` are left to the compiler, and a kernel must not define the name of a flag. All other directives are refused:
a compiler would resolve them without knowing the flags.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

from gpusense.interface.flags import FLAGS

_DIRECTIVE = re.compile(r"\s*#\s*(\w*)\s*(.*?)\s*(//.*)?$")
_CONDITION = re.compile(r"(!?)\s*([A-Z0-9_]+)$")
_PASSED = ("define", "pragma")


@dataclass
class _Branches:
    """An open ``#if`` and the state of its branches."""

    line: int  # line number of the ``#if``
    taken: bool  # the current branch is kept
    done: bool  # this branch or an earlier one is kept
    ended: bool = False  # ``#else`` has been read


@functools.lru_cache(maxsize=512)
def resolve(text: str, flags: frozenset[str], name: str = "source") -> str:
    """Keep the taken branches of ``#if`` and ``#elif`` with ``FLAG`` or ``!FLAG``; the rest becomes empty lines.

    Lines keep their numbers, so that a compiler's message names the place in the file.
    """
    kept: list[str] = []
    open_branches: list[_Branches] = []
    continued = False
    for number, line in enumerate(text.splitlines(), 1):
        # A line that continues a macro is not a directive.
        match = None if continued else _DIRECTIVE.match(line)
        continued = line.endswith("\\")
        keep = all(each.taken for each in open_branches)
        if match is not None:
            where = f"{name}:{number}"
            if continued and match.group(1) not in _PASSED:
                raise ValueError(f"{where}: a directive must stand on one line, got {line.strip()!r}")
            keep = _directive(where, number, match.group(1), match.group(2), flags, open_branches) and keep
        kept.append(line if keep else "")
    if open_branches:
        raise ValueError(f"{name}:{open_branches[-1].line}: #if must have an #endif, got none")
    return "\n".join(kept) + "\n"


def _directive(
    where: str, number: int, word: str, rest: str, flags: frozenset[str], open_branches: list[_Branches]
) -> bool:
    """Process a directive, and return whether it is left to the compiler."""
    if word in _PASSED:
        defined = re.match(r"\w*", rest)
        if word == "define" and defined is not None and defined.group() in FLAGS:
            raise ValueError(f"{where}: #define must name no flag, got {defined.group()}")
        return True
    if word == "if":
        taken = _is_true(where, rest, flags)
        open_branches.append(_Branches(number, taken, taken))
        return False
    if word not in ("elif", "else", "endif"):
        rule = "a directive must be #if, #elif, #else, #endif, #define or #pragma"
        raise ValueError(f"{where}: {rule}, got {f'#{word} {rest}'.strip()!r}")
    if not open_branches:
        raise ValueError(f"{where}: #{word} must come after an #if, got none")
    if word != "elif" and rest:
        raise ValueError(f"{where}: #{word} must stand alone, got {f'#{word} {rest}'!r}")
    last = open_branches[-1]
    if word == "endif":
        open_branches.pop()
        return False
    if last.ended:
        raise ValueError(f"{where}: #{word} must come before the #else of line {last.line}'s #if, got it after")
    true = _is_true(where, rest, flags) if word == "elif" else True
    last.taken, last.ended = true and not last.done, word == "else"
    last.done = last.done or last.taken
    return False


def _is_true(where: str, condition: str, flags: frozenset[str]) -> bool:
    """Return whether a condition holds."""
    match = _CONDITION.match(condition)
    if match is None or match.group(2) not in FLAGS:
        raise ValueError(f"{where}: condition must be one known flag, got {condition!r}")
    return (match.group(2) in flags) != (match.group(1) == "!")
