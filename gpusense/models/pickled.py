"""Copies and pickles of models: the constructor's arguments, without any state of a device."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self, cast

from gpusense.backends import Selection
from gpusense.backends.base import Backend


class Pickled(ABC):
    """Base of objects whose copies and pickles call the constructor again.

    A pickle keeps the constructor's selection string, so "auto" may choose another device on another machine. A queue
    is replaced by the selection string of its device. A copy is on the same device.
    """

    _selection: Selection

    @property
    @abstractmethod
    def backend(self) -> Backend:
        """The backend that holds the buffers."""

    @abstractmethod
    def _arguments(self) -> dict[str, Any]:
        """Return the arguments of the constructor except ``backend`` by name, with the current map."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        asked = self._selection if isinstance(self._selection, str) else self.backend.info.selection
        return _made, (type(self), self._arguments(), asked)

    def __copy__(self) -> Self:
        make: Any = type(self)
        return cast(Self, make(**self._arguments(), backend=self.backend))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        make: Any = type(self)
        made = memo[id(self)] = make(**copy.deepcopy(self._arguments(), memo), backend=self.backend)
        return cast(Self, made)


def _made(kind: Any, arguments: dict[str, Any], backend: str) -> Any:
    """Make an object of a class from a pickle."""
    return kind(**arguments, backend=backend)
