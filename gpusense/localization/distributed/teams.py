"""Teams of shards, in this process or in worker processes; all shards of a team run the same method."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

from gpusense.localization.distributed import shard_registry
from gpusense.localization.distributed.parts import finished
from gpusense.localization.distributed.shard import Shard


class LocalTeam:
    """Shards in this process; a single thread starts the work of all before it waits for the first.

    Args:
        models: Models of each shard.
        capacity: Most particles of a shard.
        residual: Whether to draw by residual resampling.

    Attributes:
        devices: Selection strings of the devices.
        direct: Whether particles are copied from device to device instead of through the host.
    """

    def __init__(self, models: Sequence[Sequence[Any]], capacity: int, residual: bool) -> None:
        self._shards = [Shard(each, capacity, residual) for each in models]
        self.devices = [str(each[0].device.selection) for each in models]
        self.direct = all(one.reaches(other) for one in self._shards for other in self._shards)

    def each(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Run a method of all shards, each with its arguments, and return the results."""
        steps = [getattr(one, method)(*own) for one, own in zip(self._shards, arguments, strict=True)]
        for one in steps:
            next(one)
        return [finished(one) for one in steps]

    def hand_on(self, source: int) -> None:
        """Copy the particles of all shards to each, from device to device."""
        self.each("take", [(source, self._shards)] * len(self._shards))

    def close(self) -> None:
        """Forget the shards."""
        self._shards = []


class RemoteTeam:
    """Shards in other processes, each behind an executor of one worker.

    Args:
        executors: One for each shard; each must run all functions in the same process.
        make: Function of a module that returns the models of a device.
        devices: Selection strings, for workers without a chosen device.
        capacity: Most particles of a shard.
        residual: Whether to draw by residual resampling.

    Attributes:
        devices: Selection strings of the devices.
        direct: False, since particles are copied through this process.
    """

    direct = False

    def __init__(
        self,
        executors: Sequence[Executor],
        make: Callable[[str], Any],
        devices: Sequence[str],
        capacity: int,
        residual: bool,
    ) -> None:
        self._executors = list(executors)
        self._names = [secrets.token_hex(8) for _ in executors]
        made = [
            executor.submit(shard_registry.hold, name, make, device, capacity, residual)
            for executor, name, device in zip(executors, self._names, devices, strict=True)
        ]
        self.devices = [future.result() for future in made]

    def each(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Run a method of all shards, each with its arguments, and return the results."""
        running = [
            executor.submit(shard_registry.call, name, method, *own)
            for executor, name, own in zip(self._executors, self._names, arguments, strict=True)
        ]
        return [future.result() for future in running]

    def hand_on(self, source: int) -> None:
        """Refuse, since the shards cannot reach each other."""
        raise NotImplementedError

    def close(self) -> None:
        """Forget the shards."""
        for executor, name in zip(self._executors, self._names, strict=True):
            executor.submit(shard_registry.release, name).result()
