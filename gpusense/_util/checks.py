"""Checks of arguments. Every message reads ``{argument}: {rule}, got {value}``."""

from __future__ import annotations

import math
import numbers
import os
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 120


def show(value: object) -> str:
    """A value as a message shows it: short and on one line."""
    try:
        text = str(value) if isinstance(value, (numbers.Real, np.bool)) else _REPR.repr(value)
    except ValueError:  # an integer of more than 4300 digits
        text = f"a huge {type(value).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= 120 else text[:117] + "..."


def shape_text(shape: Sequence[int | str]) -> str:
    """A shape as a message shows it: ``("N", 3)`` becomes ``(N, 3)``."""
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def real(
    name: str,
    value: object,
    *,
    above: float | None = None,
    low: float | None = None,
    below: float | None = None,
    high: float | None = None,
) -> float:
    """A finite real number within the limits that are given.

    Args:
        name: the argument's name.
        value: what the caller passed.
        above: the number must be greater than this.
        low: the number must be at least this.
        below: the number must be less than this.
        high: the number must be at most this.

    Raises:
        TypeError: the value is not a real number (a bool is not).
        ValueError: it is not finite, or breaks a limit.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name}: must be a real number, got {show(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    limits = ((">", above), (">=", low), ("<", below), ("<=", high))
    kept = (
        math.isfinite(number)
        and (above is None or number > above)
        and (low is None or number >= low)
        and (below is None or number < below)
        and (high is None or number <= high)
    )
    if not kept:
        rule = " and ".join(["finite", *(f"{sign} {limit}" for sign, limit in limits if limit is not None)])
        raise ValueError(f"{name}: must be {rule}, got {show(value)}")
    return number


def integer(name: str, value: object, *, low: int | None = None, high: int | None = None) -> int:
    """An integer within the limits (inclusive) that are given.

    Raises:
        TypeError: the value is not an integer (a bool or 2.0 is not).
        ValueError: it breaks a limit.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name}: must be an integer, got {show(value)}")
    number = int(value)
    if (low is not None and number < low) or (high is not None and number > high):
        limits = ((">=", low), ("<=", high))
        rule = " and ".join(f"{sign} {limit}" for sign, limit in limits if limit is not None)
        raise ValueError(f"{name}: must be {rule}, got {show(value)}")
    return number


def choice(name: str, value: object, options: Sequence[str]) -> str:
    """One of a few words.

    Raises:
        TypeError: the value is not a string.
        ValueError: it is none of the options.
    """
    rule = f"must be one of {', '.join(map(repr, options))}"
    if not isinstance(value, str):
        raise TypeError(f"{name}: {rule}, got {show(value)}")
    if value not in options:
        raise ValueError(f"{name}: {rule}, got {show(value)}")
    return value


def as_array(name: str, value: object) -> NDArray[Any]:
    """``numpy.asarray`` of a value, whatever its dtype.

    Raises:
        ValueError: the value is a ragged sequence.
    """
    try:
        return np.asarray(cast("ArrayLike", value))
    except ValueError:
        raise ValueError(f"{name}: must be an array of one shape, got {show(value)}") from None


def array(
    name: str,
    value: object,
    shape: Sequence[int | str] | None = None,
    *,
    finite: bool = True,
    dtype: DTypeLike | None = np.float64,
) -> NDArray[Any]:
    """An array of real numbers from anything that ``numpy.asarray`` takes.

    Args:
        name: the argument's name.
        value: what the caller passed; it is copied only where its dtype differs.
        shape: an integer is an exact length, a letter any length; None leaves the shape unchecked.
        finite: refuse NaN and infinities.
        dtype: the result's dtype. An integer dtype accepts integers only. None keeps a floating
            dtype as it is (in the machine's byte order) and turns integers into float64.

    Raises:
        TypeError: the dtype is object, complex, string, bool or another that holds no real numbers,
            or is not an integer one where integers are asked for.
        ValueError: the shape or a value breaks the rule.
    """
    given = as_array(name, value)
    kinds, rule = "fiu", "must hold real numbers"
    if dtype is not None and np.dtype(dtype).kind in "iu":
        kinds, rule = "iu", "must hold integers"
    if given.dtype.kind not in kinds and not (given.size == 0 and given.dtype.kind == "f"):
        raise TypeError(f"{name}: {rule}, got dtype {given.dtype}")
    if shape is not None and not _fits(given.shape, shape):
        raise ValueError(f"{name}: shape must be {shape_text(shape)}, got {shape_text(given.shape)}")
    if dtype is None:
        dtype = given.dtype.newbyteorder("=") if given.dtype.kind == "f" else np.float64
    if finite and given.dtype.kind == "f" and not np.isfinite(given).all():
        index = np.unravel_index(int(np.argmin(np.isfinite(given))), given.shape)
        where = "" if given.ndim == 0 else f" at index {_index_text(index)}"
        raise ValueError(f"{name}: every value must be finite, got {show(given[index])}{where}")
    return given.astype(dtype, copy=False)


def check_gradients(array: object, name: str, error: Exception) -> None:
    """Say why an array is not exported where its library records its gradients, which are not computed here."""
    if getattr(array, "requires_grad", False) is True:
        raise TypeError(
            f"{name}: must not require gradients, which are not computed here, got a "
            f"{type(array).__module__}.{type(array).__name__} that does: pass {name}.detach()"
        ) from error


def path(name: str, value: object) -> Path:
    """A path from a string or path object.

    Raises:
        TypeError: the value is neither.
        ValueError: it is empty or holds a null character.
    """
    if not isinstance(value, (str, os.PathLike)):
        raise TypeError(f"{name}: must be a path, got {show(value)}")
    text = os.fspath(value)
    if not isinstance(text, str):
        raise TypeError(f"{name}: must be a path of characters, got {show(text)}")
    if not text or "\0" in text:
        raise ValueError(f"{name}: must be a non-empty path without null characters, got {show(text)}")
    return Path(text)


def existing_file(file: Path) -> Path:
    """A regular file that is there.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is a folder, a device or another thing than a regular file.
    """
    # The functions of os.path, unlike those of Path, take an impossible name for a missing file.
    if not os.path.exists(file):
        raise FileNotFoundError(f"{file}: must exist, got no such file")
    if not os.path.isfile(file):
        raise ValueError(f"{file}: must be a regular file, got another kind")
    return file


def _fits(shape: tuple[int, ...], rule: Sequence[int | str]) -> bool:
    return len(shape) == len(rule) and all(
        isinstance(wanted, str) or wanted == size for size, wanted in zip(shape, rule, strict=True)
    )


def _index_text(index: tuple[Any, ...]) -> str:
    return str(int(index[0])) if len(index) == 1 else shape_text([int(i) for i in index])
