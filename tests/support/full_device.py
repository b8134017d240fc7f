"""A device whose memory is full."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def full_device(device: Any, most: int) -> Iterator[list[int]]:
    """Refuse buffers of more than ``most`` numbers; yield the list of requested sizes."""
    empty, asked = type(device).empty, []

    def short_of_memory(self, count, dtype, *, zero=False):
        asked.append(count)
        if count > most:
            raise MemoryError("the device is full")
        return empty(self, count, dtype, zero=zero)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(device), "empty", short_of_memory)
        yield asked
