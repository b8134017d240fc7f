"""OpenCL source of a program: prelude, required files in order, and only the branches that the flags select.

A kernel's parameters are written from its row of the signature table: its file says ``kernel void name(ARGUMENTS)``.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from gpusense.interface import casters, constants, structs
from gpusense.interface.flags import FLAGS
from gpusense.interface.kernel_files import has_opencl_source, opencl_source
from gpusense.interface.lanes import takes_scalar_text, written_in_lanes
from gpusense.interface.signatures import KERNELS, Argument

_PRELUDE = """\
#pragma OPENCL FP_CONTRACT OFF
{extension}typedef {real} real;
typedef {real}2 real2;
typedef {real}4 real4;
#define FLOAT64 {float64}
#define SPLITTER ((real){splitter})
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA) || defined(__NV_CL_C_VERSION) || defined({fast_fma})
#define FUSES 1
#else
#define FUSES 0
#endif
"""
_HEAD = re.compile(r"^kernel void (\w+)\(ARGUMENTS\) \{", re.MULTILINE)
_KERNEL = re.compile(r"^kernel void .*?^\}", re.MULTILINE | re.DOTALL)
_WORD = re.compile(r"\w+")
_COMMENT, _DOUBLE = re.compile(r"//.*"), re.compile(r"\bdouble[24]?\b")
# Flags of arguments that not all code of a kernel has.
_OPTIONAL = frozenset().union(*(row.optional for row in KERNELS.values()))
_REQUIRES = re.compile(r"^// requires: (.*)$", re.MULTILINE)


def prelude(*, float64: bool, doubles: bool = False) -> str:
    """Return the head of every program, which forbids contraction and defines ``real``.

    FUSES says whether the device has a fused multiply-add; elsewhere ``fma`` is a slow call. NVIDIA's driver does not
    define the macro for it.

    ``float64``: ``real`` is float64; ``doubles``: the program uses float64 even where ``real`` is float32.
    """
    return _PRELUDE.format(
        extension="#pragma OPENCL EXTENSION cl_khr_fp64 : enable\n" if float64 or doubles else "",
        real="double" if float64 else "float",
        float64=int(float64),
        splitter="134217729" if float64 else "4097",
        fast_fma="FP_FAST_FMA" if float64 else "FP_FAST_FMAF",
    )


def parameters(kernel: str, flags: frozenset[str]) -> str:
    """Return the parameters of a kernel's code in OpenCL C, in the order of its row."""
    row = KERNELS[kernel].with_flags(flags)
    star = "*restrict " if row.apart else "*"
    return ", ".join(
        f"const {argument.type} {argument.name}"
        if argument.shape is None
        else f"global {'' if argument.output else 'const '}{argument.type} {star}{argument.name}"
        for argument in row.arguments
    )


def source_text(file: str, flags: frozenset[str]) -> str:
    """Return the text of a kernel file with the parameters of its kernels for a set of flags."""
    return _with_parameters(opencl_source(file), file, flags & _OPTIONAL)


def _without_value(argument: Argument) -> str:
    """Declare an argument that the code of a kernel names and does not read."""
    if argument.shape is None:
        return f"const {argument.type} {argument.name} = {'{0}' if argument.is_struct else '0'};"
    return f"global {'' if argument.output else 'const '}{argument.type} *{argument.name} = 0;"


@functools.lru_cache(maxsize=512)
def _with_parameters(text: str, file: str, flags: frozenset[str]) -> str:
    def head(match: re.Match[str]) -> str:
        name = match.group(1)
        if name not in KERNELS:
            raise ValueError(f"{file}.cl: a kernel must have a row in the signature table, got {name!r}")
        absent = [one for one in KERNELS[name].arguments if one.flag not in ("", *flags)]
        return " ".join([f"kernel void {name}({parameters(name, flags)}) {{", *map(_without_value, absent)])

    return _HEAD.sub(head, text)


def required_files(name: str, flags: frozenset[str] = frozenset()) -> list[str]:
    """List the files of a kernel file's program, the file itself last.

    ``IN_LANES`` replaces ``<name>`` by ``lanes/<name>``, if that file exists. Names in ``// requires:`` are taken
    literally, so a file in lanes may name files of both folders. ``caster`` is replaced by the flags' caster, and
    ``lanes/caster`` by its body in lanes or else by ``lanes/other_caster``.
    """
    return _with_requirements(f"lanes/{name}" if _in_lanes(name, flags) else name, flags)


def _in_lanes(name: str, flags: frozenset[str]) -> bool:
    return "IN_LANES" in flags and has_opencl_source(f"lanes/{name}")


def _with_requirements(name: str, flags: frozenset[str]) -> list[str]:
    files: list[str] = []
    for needed in _requirements(name):
        if needed == "caster":
            needed = casters.caster_file(flags)
        elif needed == "lanes/caster":
            needed = f"lanes/{casters.caster_file(flags)}"
            needed = needed if has_opencl_source(needed) else "lanes/other_caster"
        files += [file for file in _with_requirements(needed, flags) if file not in files]
    return [*files, name]


def _requirements(name: str) -> list[str]:
    match = _REQUIRES.search(opencl_source(name))
    return match.group(1).split() if match else []


def _scalar_source(file: str) -> str | None:
    """Return the scalar file of the name of a file in lanes that takes functions; None for all other files."""
    scalar = file.removeprefix("lanes/")
    takes = scalar != file and has_opencl_source(scalar) and takes_scalar_text(opencl_source(file))
    return scalar if takes else None


def uses_double(file: str, flags: frozenset[str] = frozenset()) -> bool:
    """Return whether a kernel file computes in float64 also where the model's precision is float32."""
    kept = (_kept(needed, flags - {"FLOAT64"}) for needed in required_files(file, flags))
    return any(_names_double(text) for text in kept)


@functools.lru_cache(maxsize=512)
def _names_double(text: str) -> bool:
    """Return whether a source, or a struct that it names, has a float64 number."""
    code = _COMMENT.sub("", text)
    return _DOUBLE.search(code + _declarations(code)) is not None


def _declarations(text: str) -> str:
    """Return the declarations of the structs that a source names."""
    words = _words(text)
    return "".join(structs.declaration(name) for name in structs.STRUCTS if name in words)


@functools.lru_cache(maxsize=512)
def _words(text: str) -> frozenset[str]:
    return frozenset(_WORD.findall(text))


def _kept(file: str, flags: frozenset[str]) -> str:
    """Return a kernel file with the branches that the flags select; the file need not name all flags."""
    text = source_text(file, flags)
    return resolve(text, flags & _words(text), f"{file}.cl")


def assemble(file: str, flags: frozenset[str]) -> str:
    """Return the complete OpenCL C source of a kernel file for a set of flags."""
    head = prelude(float64="FLOAT64" in flags, doubles=uses_double(file, flags))
    texts: dict[str, str] = {}
    for needed in required_files(file, flags):
        text, scalar = _kept(needed, flags), _scalar_source(needed)
        sources = texts if scalar is None else {scalar: _kept(scalar, flags)} | texts
        texts[needed] = written_in_lanes(text, needed, sources)
    *_, last = texts
    # Only the kernels of the last file, the program's, are launched.
    kept = {name: text if name == last else _KERNEL.sub(_blank, text) for name, text in texts.items()}
    body = "".join(f'#line 1 "{name}.cl"\n{text}' for name, text in kept.items())
    return head + _definitions(texts) + _declarations(body) + body


def _definitions(files: Iterable[str]) -> str:
    """Return the constants of kernel files; a file in lanes has the constants of its scalar file."""
    shared = (constants.OF_FILES.get(file.removeprefix("lanes/"), {}).items() for file in files)
    return "".join(dict.fromkeys(_definition(name, value) for pairs in shared for name, value in pairs))


def _definition(name: str, value: Any) -> str:
    """Return a number as a macro, a tuple as a macro for each number, or a list as an array."""
    if isinstance(value, list):
        kind = "double" if isinstance(value[0], float) else "uint"
        return f"constant {kind} {name}[{len(value)}] = {{{', '.join(map(str, value))}}};\n"
    if isinstance(value, tuple):
        return "".join(f"#define {name}_{i} {number}\n" for i, number in enumerate(value))
    return f"#define {name} {value}{'f' if isinstance(value, np.float32) else ''}\n"


def _blank(match: re.Match[str]) -> str:
    """Return as many empty lines as a match has."""
    return "\n" * match.group().count("\n")


def with_places(log: str, source: str) -> str:
    """Return a compiler's log with places of the assembled source, ``<kernel>:114:``, replaced by ``raycast.cl:48:``.

    Most drivers follow the ``#line`` directives of a source; NVIDIA's counts lines of the assembled source.
    """

    def place(match: re.Match[str]) -> str:
        number = int(match.group(1))
        above = source.splitlines()[:number]
        marks = [i for i, line in enumerate(above, 1) if line.startswith("#line 1 ")]
        if not marks:
            return match.group(0)
        file = above[marks[-1] - 1].split('"')[1]
        return f"{file}:{number - marks[-1]}:"

    return re.sub(r"<\w+>:(\d+):", place, log)


def relevant(file: str, flags: frozenset[str]) -> frozenset[str]:
    """Return the flags that change a kernel file's code: one program serves all flags that agree on them."""
    files = required_files(file, flags)
    files += [scalar for scalar in map(_scalar_source, files) if scalar is not None]
    words = set().union(*(_words(source_text(needed, _OPTIONAL)) for needed in files))
    words |= _words("".join(structs.declaration(name) for name in structs.STRUCTS if name in words))
    if any({"caster", "lanes/caster"} & set(_requirements(needed)) for needed in files):
        words |= casters.FLAGS.keys()
    if _in_lanes(file, flags):
        words.add("IN_LANES")
    unknown = flags - FLAGS.keys()
    if unknown:
        raise ValueError(f"flags: must be among {sorted(FLAGS)}, got {sorted(unknown)}")
    words |= set().union(*(row.optional for row in KERNELS.values() if row.file == file))
    if "real" in words:
        words.add("FLOAT64")
    return flags & words


# ---- the preprocessor of kernel sources: keep the branches that a set of flags selects
#
# ``#define`` and ``#pragma`` are left to the compiler. Other directives than conditions are refused: a compiler would
# resolve them without knowing the flags.


_RULE = "a directive must be #if FLAG or #if !FLAG, its #elif, #else or #endif, #define of no flag, or #pragma"
_PASSED = re.compile(r"\s*#\s*(?:pragma\b|define\s+(\w+))")
_CONDITION = re.compile(r"\s*#\s*(?:(if|elif)\s*(!?)\s*([A-Z0-9_]+)|(else|endif))\s*(?://.*)?$")


@functools.lru_cache(maxsize=512)
def resolve(text: str, flags: frozenset[str], name: str = "source") -> str:
    """Keep the taken branches of ``#if`` and ``#elif`` with ``FLAG`` or ``!FLAG``; the rest becomes empty lines.

    Lines keep their numbers, so that a compiler's message names the place in the file.
    """
    kept: list[str] = []
    # For each open #if: its line, whether the branch is taken, and whether an earlier one was; None after #else.
    branches: list[tuple[int, bool, bool | None]] = []
    continued = False
    for number, line in enumerate(text.splitlines(), 1):
        # A line that continues a macro is not a directive.
        directive = not continued and line.lstrip().startswith("#")
        continued = line.endswith("\\")
        passed = _PASSED.match(line) if directive else None
        if directive and (passed[1] in FLAGS if passed else not _follows(line, number, flags, branches)):
            raise ValueError(f"{name}:{number}: {_RULE}, got {line.strip()!r}")
        kept.append(line if (passed or not directive) and all(taken for _, taken, _ in branches) else "")
    if branches:
        raise ValueError(f"{name}:{branches[-1][0]}: #if must have an #endif, got none")
    return "\n".join(kept) + "\n"


def _follows(line: str, number: int, flags: frozenset[str], branches: list[tuple[int, bool, bool | None]]) -> bool:
    """Open, change or close a branch, and return whether a line is a valid condition."""
    match = _CONDITION.match(line)
    if match is None or not (match[4] or match[3] in FLAGS):
        return False
    word, true = match[1] or match[4], bool(match[4]) or (match[3] in flags) != (match[2] == "!")
    if word == "if":
        branches.append((number, true, true))
        return True
    if not branches or (branches[-1][2] is None and word != "endif"):
        return False
    begin, _, done = branches.pop()
    if word != "endif":
        branches.append((begin, true and not done, None if word == "else" else done or true))
    return True
