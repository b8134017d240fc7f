"""Check and convert arguments. Every message reads ``{argument}: {rule}, got {value}``."""

from __future__ import annotations

import itertools
import math
import numbers
import os
import reprlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

T = TypeVar("T")

FARTHEST = 1e9
"""Largest coordinate of a position or motion [m]; UTM reaches 1e7."""
SMALLEST = 1e-9
"""Smallest length of a sensor [m]."""
_DOUBLE = np.dtype(np.float64)
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 120


def show(value: object) -> str:
    """Return a value as text for a message: on one line, at most 120 characters."""
    try:
        text = str(value) if isinstance(value, (numbers.Real, np.bool)) else _REPR.repr(value)
    except ValueError:  # an integer of more than 4300 digits
        text = f"a huge {type(value).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= 120 else text[:117] + "..."


def shape_text(shape: Sequence[int | str]) -> str:
    """Return a shape as text for a message: ``("N", 3)`` becomes ``(N, 3)``."""
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
    """Return ``value`` as a float after checking that it is finite and within limits, some of them exclusive."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name}: must be a real number, got {show(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    limits = ((">", above), (">=", low), ("<", below), ("<=", high))
    within = (
        math.isfinite(number)
        and (above is None or number > above)
        and (low is None or number >= low)
        and (below is None or number < below)
        and (high is None or number <= high)
    )
    if not within:
        rule = " and ".join(["finite", *(f"{sign} {limit}" for sign, limit in limits if limit is not None)])
        raise ValueError(f"{name}: must be {rule}, got {show(value)}")
    return number


def integer(name: str, value: object, *, low: int | None = None, high: int | None = None) -> int:
    """Return ``value`` as an int after checking that it is an integer from ``low`` to ``high``, both included."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name}: must be an integer, got {show(value)}")
    number = int(value)
    if (low is not None and number < low) or (high is not None and number > high):
        limits = ((">=", low), ("<=", high))
        rule = " and ".join(f"{sign} {limit}" for sign, limit in limits if limit is not None)
        raise ValueError(f"{name}: must be {rule}, got {show(value)}")
    return number


def choice(name: str, value: object, options: Sequence[str]) -> str:
    """Return ``value`` after checking that it is one of ``options``."""
    rule = f"must be one of {', '.join(map(repr, options))}"
    if not isinstance(value, str):
        raise TypeError(f"{name}: {rule}, got {show(value)}")
    if value not in options:
        raise ValueError(f"{name}: {rule}, got {show(value)}")
    return value


def boolean(name: str, value: object) -> bool:
    """Return ``value`` after checking that it is True or False; 0 and 1 are refused."""
    if not isinstance(value, (bool, np.bool)):
        raise TypeError(f"{name}: must be True or False, got {show(value)}")
    return bool(value)


def instance(name: str, value: object, kind: type[T], *, optional: bool = False) -> T:
    """Return ``value`` after checking that it is an instance of ``kind``, or None if ``optional``."""
    if not isinstance(value, kind) and not (optional and value is None):
        word = kind.__name__
        article = "" if word.endswith("s") else "an " if word[0] in "AEIOU" else "a "
        raise TypeError(f"{name}: must be {article}{word}{' or None' if optional else ''}, got {show(value)}")
    return cast(T, value)


def or_default(name: str, value: object, kind: Callable[[], T]) -> T:
    """Return ``value`` after checking that it is an instance of ``kind``; None becomes an instance with defaults."""
    return kind() if value is None else instance(name, value, cast("type[T]", kind))


def as_array(name: str, value: object, *, masked: bool = False) -> NDArray[Any]:
    """Return ``numpy.asarray(value)`` of any dtype; masked values become NaN if allowed, and their integers float64."""
    if type(value) is np.ndarray:
        return value
    check_values(name, value)
    try:
        plain: Any = filled(value) if masked else unmasked(name, value)
        return np.asarray(plain)
    except ValueError as error:
        if str(error).startswith(f"{name}: "):
            raise
        raise ValueError(f"{name}: must be an array of one shape, got {show(value)}") from None


def array(
    name: str,
    value: object,
    shape: Sequence[int | str] | None = None,
    *,
    finite: bool = True,
    largest: float = math.inf,
    dtype: DTypeLike | None = np.float64,
) -> NDArray[Any]:
    """Return ``value`` as an array of real numbers, copied only if its dtype changes.

    In ``shape`` an integer is an exact length, a letter any length. ``finite`` refuses NaN, infinities and masked
    values, which otherwise become NaN. An integer ``dtype`` accepts integers only; None keeps a floating dtype (in the
    machine's byte order) and converts integers to float64.
    """
    if type(value) is np.ndarray and value.dtype == _DOUBLE and (dtype is None or dtype is np.float64):
        # Fast path for most arguments: the other checks take five times as long.
        fits = shape is None or _fits(value.shape, shape)
        if fits and (not finite or np.logical_and.reduce(np.isfinite(value), axis=None)):
            return value if largest == math.inf else _limited(name, value, largest)
    values = value if type(value) is np.ndarray else as_array(name, value, masked=not finite)
    kinds, rule = "fiu", "must hold real numbers"
    if dtype is not None and np.dtype(dtype).kind in "iu":
        kinds, rule = "iu", "must hold integers"
    if values.dtype.kind not in kinds and not (values.size == 0 and values.dtype.kind == "f"):
        raise TypeError(f"{name}: {rule}, got dtype {values.dtype}")
    if shape is not None and not _fits(values.shape, shape):
        single = len(shape) > 1 and shape[0] == "N" and _fits(values.shape, shape[1:])
        hint = f"; a single one is {name}[None]" if single else ""
        raise ValueError(f"{name}: shape must be {shape_text(shape)}, got {shape_text(values.shape)}{hint}")
    if dtype is None:
        dtype = values.dtype.newbyteorder("=") if values.dtype.kind == "f" else np.float64
    if finite and values.dtype.kind == "f" and not np.isfinite(values).all():
        raise ValueError(f"{name}: every value must be finite, got {_first(values, ~np.isfinite(values))}")
    if dtype is not None and np.dtype(dtype).kind == "i" and values.dtype.kind == "u" and values.size:
        most = int(np.iinfo(np.dtype(dtype)).max)
        if values.max() > most:
            raise ValueError(f"{name}: every value must be <= {most}, got {_first(values, values > most)}")
    converted = values.astype(dtype, copy=False)
    return converted if largest == math.inf else _limited(name, converted, largest)


def _limited(name: str, values: NDArray[Any], largest: float) -> NDArray[Any]:
    """Return ``values`` after checking that no finite one is larger in magnitude than ``largest``."""
    if np.logical_and.reduce(np.abs(values) <= largest, axis=None):
        return values
    beyond = np.isfinite(values) & ((values > largest) | (values < -largest))
    if beyond.any():
        raise ValueError(f"{name}: every value must be from -{largest:g} to {largest:g}, got {_first(values, beyond)}")
    return values


def _first(values: NDArray[Any], bad: NDArray[np.bool]) -> str:
    """Return the first of the bad values as text, with its index."""
    index = np.unravel_index(int(np.argmax(bad)), values.shape)
    return show(values[index]) + ("" if values.ndim == 0 else f" at index {_index_text(index)}")


def indices(
    name: str, value: object, size: int, shape: Sequence[int | str] | None = None, *, low: int = 0
) -> NDArray[np.int64]:
    """Return ``value`` as an array of indices from ``low`` to ``size`` - 1."""
    found = array(name, value, shape, dtype=np.int64)
    bad = (found < low) | (found >= size)
    if bad.any():
        raise ValueError(f"{name}: every index must be in [{low}, {size}), got {_first(found, bad)}")
    return found


def broadcast(named: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
    """Return named arrays as views of one shape."""
    try:
        return list(np.broadcast_arrays(*named.values()))
    except ValueError:
        shapes = [shape_text(each.shape) for each in named.values()]
        *others, last = named
        rule = f"shape must broadcast with {' and '.join(others)}, {' and '.join(shapes[:-1])}"
        raise ValueError(f"{last}: {rule}, got {shapes[-1]}") from None


def check_values(name: str, array: object) -> None:
    """Refuse an array that JAX traces and that has no values."""
    if type(array).__module__.partition(".")[0] == "jax" and isinstance(array, sys.modules["jax"].core.Tracer):
        raise TypeError(
            f"{name}: must have values, got an array that JAX traces (jit, grad, vmap); only the poses of "
            "log_likelihood of an interpolated likelihood field may be traced"
        )


def check_gradients(array: object, name: str, error: Exception) -> None:
    """Raise a clear error if ``array`` cannot be exported because its library records gradients."""
    if getattr(array, "requires_grad", False) is True:
        raise TypeError(
            f"{name}: must not require gradients, which are not computed here, got a "
            f"{type(array).__module__}.{type(array).__name__} that does: pass {name}.detach()"
        ) from error


def nested(name: str, value: object, *, deepest: int, most: int) -> int:
    """Count the values in nested mappings (with keys), lists and tuples, and every 64 characters of strings."""
    count = 0
    inner: list[Iterator[Any]] = [iter([value])]
    while inner:
        for one in inner[-1]:
            count += 1 + (len(one) >> 6 if isinstance(one, str) else 0)
            if count > most:
                raise ValueError(f"{name}: must hold at most {most} values, got more")
            if isinstance(one, (Mapping, list, tuple)):
                if len(inner) > deepest:
                    raise ValueError(f"{name}: must be nested at most {deepest} deep, got more")
                inner.append(itertools.chain.from_iterable(one.items()) if isinstance(one, Mapping) else iter(one))
                break
        else:
            inner.pop()
    return count


def path(name: str, value: object) -> Path:
    """Return ``value``, a string or path object, as a path."""
    if not isinstance(value, (str, os.PathLike)):
        raise TypeError(f"{name}: must be a path, got {show(value)}")
    text = os.fspath(value)
    if not isinstance(text, str):
        raise TypeError(f"{name}: must be a path of characters, got {show(text)}")
    if not text or "\0" in text:
        raise ValueError(f"{name}: must be a non-empty path without null characters, got {show(text)}")
    return Path(text)


def existing_file(file: Path) -> Path:
    """Return ``file`` after checking that it is an existing regular file."""
    # For an impossible name os.path reports a missing file; Path raises another error.
    if not os.path.exists(file):
        found = "a link that leads to no file" if os.path.islink(file) else "no such file"
        raise FileNotFoundError(f"{file}: must exist, got {found}")
    if not os.path.isfile(file):
        raise ValueError(f"{file}: must be a regular file, got another kind")
    return file


def _fits(shape: tuple[int, ...], rule: Sequence[int | str]) -> bool:
    if shape == rule:
        return True
    if len(shape) != len(rule):
        return False
    # A generator would be one more call per item.
    for size, length in zip(shape, rule, strict=True):  # noqa: SIM110
        if not isinstance(length, str) and length != size:
            return False
    return True


def _index_text(index: tuple[Any, ...]) -> str:
    return str(int(index[0])) if len(index) == 1 else shape_text([int(i) for i in index])


# ---- convert NumPy's masked arrays: a masked reading is missing, a masked pose or cell is an error


_NUMBERS = {int, float, np.float32, np.float64}


def is_masked(value: object) -> bool:
    """Return whether a value is a masked array, or a list or tuple that contains one at any depth."""
    if type(value) is np.ndarray:
        return False
    library = sys.modules.get("numpy.ma")
    if library is None:
        return False
    if isinstance(value, (list, tuple)):
        # Lists of numbers are long: inspect only types.
        kinds = set(map(type, value))
        if kinds <= _NUMBERS:
            return False
        return any(issubclass(kind, library.MaskedArray) for kind in kinds) or (
            any(issubclass(kind, (list, tuple)) for kind in kinds) and any(map(is_masked, value))
        )
    return isinstance(value, library.MaskedArray)


def filled(value: Any) -> Any:
    """Return a masked array, or nested lists that contain one, as floats with NaN where masked; else the value."""
    if not is_masked(value):
        return value
    data, mask = _parts(value)
    if not mask.any():
        return data
    if data.dtype.kind not in "fc":
        data = data.astype(np.float64)
    return np.where(mask, data.dtype.type(np.nan), data)


def unmasked(name: str, value: Any) -> Any:
    """Return a masked array without masked values as a plain array, and other values unchanged."""
    if not is_masked(value):
        return value
    data, mask = _parts(value)
    if mask.any():
        index = tuple(int(i) for i in np.argwhere(mask)[0])
        place = f" at index {index[0] if len(index) == 1 else index}" if index else ""
        raise ValueError(f"{name}: no value may be masked, got {int(mask.sum())}, the first{place}")
    return data


def _parts(value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers and the mask of a masked array, or of nested lists that contain one."""
    if isinstance(value, (list, tuple)):
        datas, masks = zip(*map(_parts, value), strict=True)
        return np.stack(datas), np.stack(masks)
    if isinstance(value, np.ma.MaskedArray):
        return np.asarray(value.data), np.ma.getmaskarray(value)
    plain = np.asarray(value)
    return plain, np.zeros(plain.shape, bool)
