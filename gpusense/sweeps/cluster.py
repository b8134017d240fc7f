"""Sweeps on Dask: on a cluster on this machine, which listens on the loopback only, or on a cluster at an address.

A Dask cluster runs what its clients send: whoever reaches its ports executes code there. ``docs/sweeps.md`` has the
consequences.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import pickle
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

from gpusense._util import checks
from gpusense._util.extras import library
from gpusense.sweeps import on_worker
from gpusense.sweeps.executors import device_names
from gpusense.sweeps.local_cluster import RESOURCE, local_cluster
from gpusense.sweeps.remote import Found, Link, RemoteWorker
from gpusense.sweeps.supervised import limits_of
from gpusense.sweeps.watch import Watch

# Seconds for the scheduler to answer, and for workers to end their jobs.
_ANSWER, _GOODBYE = 5.0, 10.0


class DaskExecutor(Executor):
    """Jobs on a Dask cluster, one at a time on each worker, in a process that the worker supervises.

    Workers of a cluster at an address are started by ``GPUSENSE_SWEEP_DEVICE=warp:cuda:0 dask worker ADDRESS
    --nthreads 1 --resources gpusense=1``, one for each device. If any worker declares this resource, workers without it
    take no jobs.

    Args:
        address: Address of a scheduler, such as ``"tcp://10.0.0.1:8786"``; None starts a cluster in this process, whose
            scheduler, workers and dashboard listen on 127.0.0.1 only.
        devices: Devices of a cluster that is started: selection strings, one for each worker, or the number of workers.
        security: A ``distributed.Security`` with certificates for TLS; None takes the certificates of Dask's
            configuration, if any.
        timeout: Longest time to connect, and to wait for a worker if there is none [s].
        job_timeout: See :class:`ProcessExecutor`.
        memory_limit: See :class:`ProcessExecutor`; the memory limit of a Dask worker also applies to its jobs.

    Attributes:
        slots: Number of workers.
        address: Address of the scheduler.
        dashboard: Address of the dashboard; empty without one.

    Raises:
        ImportError: Dask is not installed here, or gpusense is not on a worker.
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
        job_timeout: float | None = None,
        memory_limit: int | None = None,
    ) -> None:
        library("distributed", "a sweep on Dask")
        patience = checks.real("timeout", timeout, above=0)
        limits = limits_of(job_timeout, memory_limit)
        names = device_names(devices) if address is None else []
        self._name = secrets.token_hex(8)
        self._client: Any
        self._cluster: Any
        self._client = self._cluster = None
        self._watch: Watch | None = None
        try:
            self._connect(address, names, security, patience)
            self.address = str(self._client.scheduler.address)
            workers = self._workers()
            if workers is None:
                raise OSError(f"dask: must have a scheduler that answers, got none at {self.address}")
            self._pinned = any(one.get("resources", {}).get(RESOURCE) for one in workers.values())
            options = {"resources": {RESOURCE: 1}} if self._pinned else {}
            self._watch = Watch(
                lambda watch: Link(self._client, self._name, limits, options, lambda: watch.lost or self._ended),
                self._usable, lambda: self._ended, patience,
            )  # fmt: skip
        except BaseException:
            self._leave()
            raise

    def _connect(self, address: str | None, names: list[str], security: Any, patience: float) -> None:
        """Start a cluster or connect to the one at the address, and wait for a worker.

        Raises:
            ImportError: A worker lacks gpusense.
            OSError: There is no worker.
            ValueError: The address has no port, or the cluster is not one of TLS.
        """
        import distributed

        # A discarded client closes itself when it is collected. If that happened during the start of another client, it
        # would wait forever for a lock that this thread holds.
        gc.collect()
        if address is not None:
            _check_address(address)
        try:
            self._cluster = None if address is not None else local_cluster(names, security)
            target = address if self._cluster is None else self._cluster
            self._client = distributed.Client(target, timeout=patience, security=security, set_as_default=False)
            self._client.wait_for_workers(1, timeout=patience)
            self._client.register_plugin(_plugin(self._name, {}), name=f"gpusense-{self._name}")
        except (ImportError, AttributeError, pickle.PickleError) as error:
            raise ImportError(f"dask: every worker must have this version of gpusense, got {error}") from error
        except TypeError as error:
            if "ssl_context" not in str(error):
                raise
            raise ValueError(f"security: must have certificates for TLS, got none for {address}") from error
        except (OSError, TimeoutError) as error:
            rule = f"dask: must have a scheduler with workers at {address or 'the loopback'}"
            raise OSError(f"{rule}, got none in {patience:g} s: {checks.show(str(error))}") from error

    def __repr__(self) -> str:
        return f"DaskExecutor({self.address!r}, {self.slots} slots)"

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            self.terminate()
        return super().__exit__(kind, error, trace)

    def _workers(self) -> Mapping[str, Any] | None:
        """Return the scheduler's list of workers; None if it does not answer."""
        try:
            answer = self._client.sync(_identity, self._client, callback_timeout=_ANSWER)
        except Exception:
            return None
        workers: Mapping[str, Any] = answer["workers"]
        return workers

    def _usable(self) -> list[Found] | None:
        """Return the workers that take jobs."""
        workers = self._workers()
        if workers is None:
            return None
        return [
            Found(address, one["local_directory"], one.get("status", "running") == "running")
            for address, one in workers.items()
            if one["resources"].get(RESOURCE) or not self._pinned
        ]

    @property
    def slots(self) -> int:
        """Number of jobs that run at once: the workers of a second ago."""
        return len(self._watched.workers)

    @property
    def _watched(self) -> Watch:
        assert self._watch is not None
        return self._watch

    @property
    def dashboard(self) -> str:
        """Address of the dashboard; empty without one."""
        services = self._client.scheduler_info().get("services", {})
        return str(self._client.dashboard_link) if services.get("dashboard") else ""

    @property
    def alive(self) -> bool:
        """Tell whether the scheduler is running."""
        return bool(self._client.status == "running" and not self._client.scheduler_comm.comm.closed())

    @property
    def _ended(self) -> str:
        """Reason why the scheduler has ended; empty while it runs."""
        return "" if self.alive else "the scheduler has ended"

    def send(self, contents: Mapping[str, Any]) -> None:
        """Send maps and the bytes of logs once to each worker, including workers that join later."""
        self._client.register_plugin(_plugin(self._name, dict(contents)), name=f"gpusense-{self._name}")

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a function for the next free worker; if the worker ends, the future raises :class:`WorkerDied`."""
        return self._watched.submit(_payload(fn, args, kwargs))

    def on_each(self) -> list[Executor]:
        """Return an executor for each worker, which runs functions there in one process and nowhere else."""
        return [_OneWorker(one, f"{self._name}-each") for one in list(self._watched.workers.values())]

    def terminate(self) -> None:
        """End the running jobs, and leave the cluster."""
        if self._watch is not None:
            self._watch.lose("the executor has been shut down")
        self._leave()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster after the running jobs, and end it if it was started here."""
        if self._watch is not None and not self._watch.lost:
            if self._ended:
                self._watch.lose(self._ended)
            running = self._watch.open
            for future in running if cancel_futures else ():
                future.cancel()
            if wait:
                futures.wait(running)
        self.terminate()

    def _leave(self) -> None:
        # A client without a scheduler would log that it no longer reconnects.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        if self._client is not None and self.alive:
            # Workers end the processes of this executor; workers that do not answer are not awaited.
            thread = threading.Thread(target=self._say_goodbye, daemon=True)
            thread.start()
            thread.join(_GOODBYE)
        on_worker.close_pools(self._name)
        for one in (self._client, self._cluster):
            if one is not None:
                with contextlib.suppress(OSError, TimeoutError):
                    one.close()

    def _say_goodbye(self) -> None:
        with contextlib.suppress(Exception):
            self._client.unregister_worker_plugin(f"gpusense-{self._name}")


def _check_address(address: str) -> None:
    """Check the form of a scheduler's address, since a client that fails on it leaves a traceback.

    Raises:
        ValueError: It has no host and port, or an unknown scheme.
    """
    from distributed.comm import get_address_host_port

    try:
        get_address_host_port(address)
    except ValueError as error:
        rule = "dask: must be an address such as tcp://10.0.0.1:8786"
        raise ValueError(f"{rule}, got {checks.show(address)}: {error}") from None


async def _identity(client: Any) -> Any:
    """Return a scheduler's description of itself and its workers."""
    return await client.scheduler.identity(n_workers=-1)


class _OneWorker(Executor):
    """Functions on one worker of a cluster, in a process that runs nothing else."""

    def __init__(self, worker: RemoteWorker, name: str) -> None:
        self._worker, self._name, self.slots = worker, name, 1
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="gpusense-sweep")

    def __repr__(self) -> str:
        return f"_OneWorker({self._worker.address!r})"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return self._thread.submit(self._worker.call, _payload(fn, args, kwargs), self._name)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._thread.shutdown(wait=wait, cancel_futures=cancel_futures)


def _payload(fn: Callable[..., Any], args: Any, kwargs: Any) -> bytes:
    """Return the pickle of a call, even of a function that another machine cannot import."""
    import cloudpickle

    return bytes(cloudpickle.dumps((fn, args, kwargs)))


def _plugin(name: str, contents: dict[str, Any]) -> Any:
    """Return a plugin that hands contents to each worker, and ends the processes of an executor when it leaves."""
    import distributed

    class Contents(distributed.WorkerPlugin):  # type: ignore[misc]
        """Maps and logs of a sweep."""

        def setup(self, worker: Any) -> None:
            """Keep the contents for the processes of the worker."""
            on_worker.open_pool(worker, name, contents)

        def teardown(self, worker: Any) -> None:
            """End the processes of the worker."""
            on_worker.close_pools(name, worker)

    return Contents()
