"""A backend that forwards every method to another backend."""

from __future__ import annotations

import functools
from typing import Any

from gpusense.backends.base import Backend, BackendInfo


def _forwarded(name: str) -> Any:
    """Make a method that calls the method of the same name of the backend behind."""

    @functools.wraps(getattr(Backend, name), updated=())
    def method(self: Proxy, *arguments: Any, **options: Any) -> Any:
        return getattr(self._backend, name)(*arguments, **options)

    return method


def _forwarded_property(name: str) -> Any:
    """Make a property that forwards to the wrapped backend."""
    return property(lambda self: getattr(self._backend, name))


class Proxy(Backend):
    """Base of backends that watch or count: it forwards every method to another backend.

    Launches of programs and recordings all go through ``compile``, so a subclass that overrides it sees each launch.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    @property
    def info(self) -> BackendInfo:  # type: ignore[override]
        """See Backend."""
        return self._backend.info

    alignment = _forwarded_property("alignment")
    in_batch = _forwarded_property("in_batch")
    replays = _forwarded_property("replays")
    results = _forwarded_property("results")
    upload, empty, download, part = map(_forwarded, ("upload", "empty", "download", "part"))
    refill = _forwarded("refill")
    empty_external, copy = map(_forwarded, ("empty_external", "copy"))
    compile, source, synchronize = map(_forwarded, ("compile", "source", "synchronize"))
    largest_group = _forwarded("largest_group")
    begin_batch, submit, end_batch = map(_forwarded, ("begin_batch", "submit", "end_batch"))
    address, reads, adopt, view, wrap_external = map(_forwarded, ("address", "reads", "adopt", "view", "wrap_external"))
    ahead, empty_like = map(_forwarded, ("ahead", "empty_like"))
    check_process = _forwarded("check_process")
