"""Sweeps on Dask: a cluster of this machine, which listens on the loopback only, or one at an address.

A Dask cluster runs what its clients send: whoever reaches its ports executes code there. ``docs/sweeps.md`` has the
consequences.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future
from typing import Any

from gpusense._util import checks
from gpusense._util.extras import library
from gpusense.sweeps.executors import WorkerDied
from gpusense.sweeps.worker import DEVICE, receive

LOOPBACK = "127.0.0.1"
# Resource of a Dask worker that stands for its device: a job takes one.
RESOURCE = "gpusense"
# Workers would write their life to standard error.
_QUIET = "DASK_LOGGING__DISTRIBUTED"
# Seconds for which the number of workers is believed.
_FRESH = 2.0
# Seconds to wait for a finished job's result before asking whether it still exists, and how often.
_FETCH = 2.0
_FETCHES = 15


class DaskExecutor(Executor):
    """Jobs on a Dask cluster, one at a time on each worker with a device.

    Workers of a cluster at an address are started by ``GPUSENSE_SWEEP_DEVICE=warp:cuda:0 dask worker ADDRESS
    --nthreads 1 --resources gpusense=1``, one for each device. Where no worker declares this resource, each thread
    takes jobs.

    Args:
        address: Of a scheduler, such as ``"tcp://10.0.0.1:8786"``; None starts a cluster on this machine, whose
            scheduler, workers and dashboard listen on 127.0.0.1 only.
        devices: Of a cluster that is started: selection strings, one for each worker, or the number of workers.
        security: A ``distributed.Security`` with certificates for TLS.
        timeout: Longest time to connect, and to wait for the first worker [s].

    Attributes:
        slots: Workers, or their threads.
        address: Of the scheduler.
        dashboard: Address of the dashboard; empty without one.

    Raises:
        ImportError: Dask is not installed.
        OSError: no scheduler answers at the address, or no worker joins it.
        TypeError, ValueError: an argument breaks its rule.
    """

    def __init__(
        self,
        address: str | None = None,
        *,
        devices: int | Sequence[str] = 1,
        security: Any = None,
        timeout: float = 30.0,
    ) -> None:
        distributed = library("distributed", "a sweep on Dask")
        wait = checks.real("timeout", timeout, above=0)
        self._cluster = None if address is not None else _local(devices, security)
        target = address if self._cluster is None else self._cluster
        try:
            self._client = distributed.Client(target, timeout=wait, security=security, set_as_default=False)
            self._client.wait_for_workers(1, timeout=wait)
        except (OSError, TimeoutError) as error:
            self._end()
            raise OSError(f"dask: must have a scheduler with workers at {address}, got none in {wait:g} s") from error
        self.address = str(self._client.scheduler.address)
        self._slots, self._asked = 0, -math.inf
        self._pinned = any(one.get("resources", {}).get(RESOURCE) for one in self._workers().values())

    def __repr__(self) -> str:
        return f"DaskExecutor({self.address!r}, {self.slots} slots)"

    def _workers(self) -> Mapping[str, Any]:
        workers: Mapping[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        return workers

    @property
    def slots(self) -> int:
        """Jobs that run at once, as the scheduler said within the last two seconds."""
        if time.monotonic() > self._asked + _FRESH:
            workers = self._workers().values()
            counts = [one.get("resources", {}).get(RESOURCE, 0) if self._pinned else one["nthreads"] for one in workers]
            self._slots, self._asked = int(sum(counts)), time.monotonic()
        return self._slots

    @property
    def dashboard(self) -> str:
        """Address of the dashboard; empty without one."""
        services = self._client.scheduler_info().get("services", {})
        return str(self._client.dashboard_link) if services.get("dashboard") else ""

    @property
    def alive(self) -> bool:
        """Whether the scheduler answers."""
        return bool(self._client.status == "running" and not self._client.scheduler_comm.comm.closed())

    def send(self, contents: Mapping[str, Any]) -> None:
        """Send maps and the bytes of logs once to each worker, also to those that join later."""
        self._client.register_plugin(_plugin(dict(contents)), name="gpusense-sweep")

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a function of a module; jobs of a worker that dies run on another one."""
        options: dict[str, Any] = {"resources": {RESOURCE: 1}} if self._pinned else {}
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        # pure=False: jobs of equal arguments are different jobs.
        remote = self._client.submit(fn, *args, pure=False, **options, **kwargs)
        remote.add_done_callback(lambda done: _settle(done, future))
        return future

    def on_each(self) -> list[Executor]:
        """Return an executor for each worker, which runs functions there and nowhere else."""
        return [_OneWorker(self._client, address) for address in self._workers()]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, and end it if it was started here."""
        self._end()

    def _end(self) -> None:
        # A client without its scheduler would log that it no longer reconnects.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        for one in (getattr(self, "_client", None), self._cluster):
            if one is not None:
                with contextlib.suppress(OSError, TimeoutError):
                    one.close()


class _OneWorker(Executor):
    """Functions on one worker of a cluster."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address, self.slots = client, address, 1

    def __repr__(self) -> str:
        return f"_OneWorker({self._address!r})"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        remote = self._client.submit(fn, *args, pure=False, workers=[self._address], **kwargs)
        remote.add_done_callback(lambda done: _settle(done, future))
        return future


def _settle(remote: Any, future: Future[Any]) -> None:
    """Hand the result of a Dask future on."""
    import distributed

    try:
        if remote.cancelled():
            raise CancelledError("the scheduler has lost the job")
        future.set_result(_fetched(remote))
    except distributed.scheduler.KilledWorker as error:
        future.set_exception(WorkerDied(f"workers of the job ended: {error.last_worker}"))
    except BaseException as error:
        future.set_exception(error)


def _fetched(remote: Any) -> Any:
    """Return the result of a finished Dask future.

    The result waits in its worker's memory. Where the worker ends before it is fetched, Dask runs the job again, which
    may wait behind others for hours, and every other result behind this one.

    Raises:
        WorkerDied: the result has gone with its worker.
    """
    for _ in range(_FETCHES):
        try:
            return remote.result(timeout=_FETCH)
        except TimeoutError:
            if remote.status == "error":
                # The job's own.
                raise
            if remote.status != "finished":
                break
    remote.cancel()
    raise WorkerDied("the worker ended before its result was fetched")


def _plugin(contents: dict[str, Any]) -> Any:
    """Return a plugin that hands contents to each worker."""
    import distributed

    class Contents(distributed.WorkerPlugin):  # type: ignore[misc]
        """Maps and logs of a sweep."""

        def setup(self, worker: Any) -> None:
            """Keep them in the worker's process."""
            receive(contents)

    return Contents()


def _local(devices: int | Sequence[str], security: Any) -> Any:
    """Start a cluster of this machine: a process for each device, all ports on the loopback."""
    import distributed

    names = [""] * checks.integer("devices", devices, low=1) if isinstance(devices, int) else list(devices)
    common: dict[str, Any] = dict(host=LOOPBACK, security=security)
    scheduler = {
        "cls": distributed.Scheduler,
        "options": {**common, "port": 0, "dashboard": True, "dashboard_address": f"{LOOPBACK}:0"},
    }
    workers = {
        index: {
            "cls": distributed.Nanny,
            "options": {
                **common, "nthreads": 1, "resources": {RESOURCE: 1}, "memory_limit": 0, "dashboard": False,
                "silence_logs": 40, "env": {_QUIET: "error"} | ({DEVICE: name} if name else {}),
            },
        }
        for index, name in enumerate(names)
    }  # fmt: skip
    return distributed.SpecCluster(
        scheduler=scheduler, workers=workers, silence_logs=50, asynchronous=False, security=security
    )
