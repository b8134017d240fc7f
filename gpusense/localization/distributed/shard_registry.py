"""Shards that a worker's process holds for filters in other processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from gpusense._util.worker_device import device_of
from gpusense.localization.distributed.parts import finished
from gpusense.localization.distributed.shard import Shard

_SHARDS: dict[str, Shard] = {}


def hold(name: str, make: Callable[[str], Any], device: str, capacity: int, residual: bool) -> str:
    """Make a shard in this process, and return the name of its device.

    Args:
        name: Name of the shard.
        make: Returns the models of a device.
        device: Selection string, for a worker without a chosen device.
        capacity: Most particles.
        residual: Whether to draw by residual resampling.
    """
    models = models_of(make, device_of(device))
    _SHARDS[name] = Shard(models, capacity, residual)
    return str(models[0].device.selection)


def call(name: str, method: str, *arguments: Any) -> Any:
    """Run a method of a shard of this process to its end, and return its result."""
    steps = getattr(_SHARDS[name], method)(*arguments)
    next(steps)
    return finished(steps)


def release(name: str) -> None:
    """Release a shard of this process."""
    _SHARDS.pop(name, None)


def models_of(make: Callable[[str], Any], device: str) -> list[Any]:
    """Return the models of a device as a list."""
    made = make(device)
    return list(made) if isinstance(made, Sequence) else [made]
