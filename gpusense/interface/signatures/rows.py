"""Arguments and launch shapes of kernels, and arguments that several rows share."""

from __future__ import annotations

import ast
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense.interface.structs import STRUCTS, columns, fields

_SCALARS: dict[str, np.dtype] = {
    "int": np.dtype(np.int32),
    "uchar": np.dtype(np.uint8),
    "ushort": np.dtype(np.uint16),
    "double": np.dtype(np.float64),
}
_WIDTHS = {"": 1, "2": 2, "4": 4}


def _evaluate(node: ast.expr, values: Mapping[str, Any]) -> int:
    match node:
        case ast.Constant(value=int(number)):
            return number
        case ast.Name(id=name):
            return int(values[name])
        case ast.Attribute(value=ast.Name(id=name), attr=field):
            return int(getattr(values[name], field))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _evaluate(left, values) + _evaluate(right, values)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _evaluate(left, values) * _evaluate(right, values)
    raise ValueError(f"shape: must be a sum or product of integers, names and fields, got {ast.unparse(node)!r}")


@dataclass(frozen=True)
class Argument:
    """One argument of a kernel: an array (with its shape in words), or a scalar or struct (shape None).

    Only code with ``flag`` has the argument; code of any flags where it is empty.
    """

    name: str
    type: str
    shape: str | None = None
    output: bool = False
    flag: str = ""

    @property
    def is_struct(self) -> bool:
        """Return whether the argument is a struct by value."""
        return self.shape is None and self.type in STRUCTS

    @property
    def holds_structs(self) -> bool:
        """Return whether the argument is an array of structs."""
        return self.shape is not None and self.type in STRUCTS

    @property
    def width(self) -> int:
        """Return the numbers per element: 4 for real4, and the fields of a struct."""
        if self.type in STRUCTS:
            return len(fields(self.type))
        return _WIDTHS[self.type.lstrip("abcdefghijklmnopqrstuvwxyz")]

    def elements(self, values: Mapping[str, Any]) -> int:
        """Return an array's number of elements: sums and products of integers, scalars and fields of structs."""
        assert self.shape is not None
        return _evaluate(ast.parse(self.shape, mode="eval").body, values)

    def shaped(self, numbers: np.ndarray) -> Any:
        """Return an array's numbers as the NumPy reference sees them: rows of vectors, or a struct of arrays."""
        if self.holds_structs:
            return columns(self.type, numbers)
        whole = numbers.size // self.width * self.width
        return numbers[:whole].reshape(-1, self.width) if self.width > 1 else numbers

    def dtype(self, real: np.dtype) -> np.dtype:
        """Return the NumPy dtype of one number of an array or scalar."""
        base = self.type.rstrip("24")
        return real if base == "real" or base in STRUCTS else _SCALARS[base]


@dataclass(frozen=True)
class Kernel:
    """A kernel: its file, the objects that a work-item takes, its arguments, and its work-group size.

    The first axis of a global size is rounded up to whole groups; heavier work-items have smaller groups. A kernel
    compiled with IN_LANES has groups of ``lanes_group`` work-items; with ``in_lanes`` a work-item takes as many
    neighbours of the first axis as a vector has lanes. With IN_TEAMS the ``team`` work-items of a group share an item,
    with SMALL_TEAMS an eighth as many, so the first axis has as many work-items for each. ``apart`` says that no two of
    its arrays share memory, so a compiler need not reload arguments after a write. ``registers`` limits the registers
    of a work-item of a team in NVIDIA's OpenCL, so that more teams run at once; 0 sets no limit.
    """

    file: str
    launch: tuple[str, ...]
    arguments: tuple[Argument, ...]
    group: int
    in_lanes: bool = False
    lanes_group: int = 1
    apart: bool = False
    team: int = 1
    registers: int = 0

    @functools.cached_property
    def optional(self) -> frozenset[str]:
        """The flags without which arguments are missing."""
        return frozenset(argument.flag for argument in self.arguments if argument.flag)

    @functools.cached_property
    def _rows(self) -> dict[frozenset[str], Kernel]:
        return {}

    def with_flags(self, flags: frozenset[str]) -> Kernel:
        """Return the row of the code of a set of flags, without the arguments that the code does not have."""
        chosen = flags & self.optional
        row = self._rows.get(chosen)
        if row is None:
            kept = tuple(argument for argument in self.arguments if argument.flag in ("", *chosen))
            row = self._rows[chosen] = dataclasses.replace(self, arguments=kept)
        return row

    def passed(self, flags: frozenset[str], values: Sequence[Any]) -> list[Any]:
        """Select the values that the code of a set of flags takes from the values of all arguments."""
        pairs = zip(self.arguments, values, strict=True)
        return [value for argument, value in pairs if argument.flag in ("", *flags)]


# Particles or beams of a work-item of a kernel in lanes.
LANES = 16


def lanes_of(flags: frozenset[str]) -> int:
    """Return the number of particles or beams that a work-item computes at once."""
    return LANES if "IN_LANES" in flags else 1


def team_of(row: Kernel, flags: frozenset[str]) -> int:
    """Return the number of work-items that share an item of a kernel."""
    if "IN_TEAMS" not in flags:
        return 1
    return row.team // 8 if "SMALL_TEAMS" in flags else row.team


def kernel(
    file: str,
    launch: str,
    *rows: str,
    group: int = 64,
    in_lanes: bool = False,
    lanes_group: int = 1,
    apart: bool = False,
    team: int = 1,
    registers: int = 0,
) -> Kernel:
    """Return the kernel whose arguments are rows such as ``"out real parts [particles * features] if PER_BEAM"``."""
    arguments = []
    for row in rows:
        declared, _, flag = row.partition(" if ")
        head, _, shape = declared.partition("[")
        *output, kind, name = head.split()
        arguments.append(Argument(name, kind, shape.rstrip("]") if shape else None, output == ["out"], flag))
    return Kernel(file, tuple(launch.split()), tuple(arguments), group, in_lanes, lanes_group, apart, team, registers)


WINDOW = "Window window"
POSES = ("int2 pose_cell [particles]", "real4 pose [particles]")
PLACED = (*POSES, "real4 pose_low [particles]")
