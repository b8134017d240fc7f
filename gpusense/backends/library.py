"""The library of a backend: it lists, describes and opens devices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from gpusense.backends.base import Backend
from gpusense.backends.info import BackendInfo


class Absent(NamedTuple):
    """A part of a backend that is missing on this machine."""

    name: str  # the library or device that is absent
    kind: str  # the kind of device that it would provide, ``"cpu"`` or ``"gpu"``
    reason: str  # the reason, with the remedy


class Library(ABC):
    """The loaded library of a backend."""

    @abstractmethod
    def list_devices(self) -> list[tuple[BackendInfo, Any]]:
        """Return its devices on this machine, each with the library's object for it."""

    @abstractmethod
    def open(self, info: BackendInfo, handle: Any) -> Backend:
        """Open a device with the lanes and precisions of ``info``."""

    def absent(self) -> list[Absent]:
        """Return the parts of the library that this machine lacks, such as drivers that cannot be loaded."""
        return []

    def no_device(self, install: str) -> str:
        """Return why there is no device, with the remedy.

        ``install``: the command that installs what is absent; empty where all is installed.
        """
        return f"no driver offers a device: {install or 'install or update the driver of its vendor'}"

    def is_simulator(self, info: BackendInfo) -> bool:
        """Return whether a device is a checker or an emulator: correct, but too slow to be chosen unasked."""
        return False

    def trouble(self, handle: Any) -> str:
        """Return why no kernel can run on a device, where that is known without a proof; else an empty text."""
        return ""

    def renew(self) -> None:  # noqa: B027
        """Renew verdicts that concern no single device, such as verdicts on the loading of drivers."""

    # ---- children that prove devices

    def child_setup(self) -> Any:
        """Return the data with which a child lists the same devices; JSON carries it."""
        return None

    def set_up_child(self, setup: Any) -> None:  # noqa: B027
        """Apply ``child_setup`` of a parent in this process, before any device is listed."""

    # ---- queues of users

    def queue_key(self, candidate: object) -> int | None:
        """Return a number that identifies a user's queue; None for any other object."""
        return None

    def device_of_queue(self, queue: Any) -> tuple[BackendInfo, Any]:
        """Return a queue's device as ``list_devices`` does; parts of devices have selections that are not listed."""
        raise NotImplementedError(f"{type(self).__name__} takes no queues of users")

    def open_queue(self, queue: Any, info: BackendInfo) -> Backend:
        """Return a backend that works on a user's queue."""
        raise NotImplementedError(f"{type(self).__name__} takes no queues of users")
