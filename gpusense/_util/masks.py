"""Convert NumPy's masked arrays: a masked reading is missing, a masked pose or cell is an error."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

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
    """Return a masked array, or nested lists that contain one, as an array with NaN where masked.

    Masked integers and booleans become float64. Other values are returned unchanged.
    """
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
