"""Types of arguments and arrays: literal names, dtypes, and arrays of other libraries."""

from __future__ import annotations

from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Reals: TypeAlias = NDArray[np.floating]
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool]

Precision: TypeAlias = Literal["float32", "float64"]
PRECISIONS: tuple[Precision, ...] = ("float32", "float64")
Space: TypeAlias = Literal["free", "occupied"]
Compat: TypeAlias = Literal["amcl", "beluga"]
CasterName: TypeAlias = Literal["exact", "dda", "march", "bresenham", "cddt", "lookup"]
FitMethod: TypeAlias = Literal["em", "em-book", "gradient", "hill_climb", "genetic"]
Association: TypeAlias = Literal["nearest", "sum", "joint"]
Loss: TypeAlias = Literal["linear", "soft_l1", "huber", "cauchy", "arctan"]


class SupportsDLPack(Protocol):
    """Array of PyTorch, JAX, CuPy or another library that exports DLPack."""

    def __dlpack__(self, *args: Any, **options: Any) -> Any:
        """Export the array."""


class SupportsCuda(Protocol):
    """Array on a CUDA device."""

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        """The array's address, shape and type."""


AnyArray: TypeAlias = ArrayLike | SupportsDLPack | SupportsCuda
