"""Sweeps on Dask: on a cluster on this machine, which listens on the loopback only, or on a cluster at an address.

Dask hands jobs to its workers, and its nannies replace workers that end. A job runs in a process of its worker, as on
all executors, so that its end is no end of the worker.

A Dask cluster runs what its clients send: whoever reaches its ports executes code there; see ``docs/sweeps.md``.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import logging
import pickle
import secrets
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense._util.extras import library
from gpusense.sweeps.executors import SupervisedExecutor, device_names
from gpusense.sweeps.process import Worker, WorkerDied, error_text

_LOG = logging.getLogger("gpusense")
_LOOPBACK = "127.0.0.1"
# Resource of a Dask worker that represents its device; a job takes one.
_RESOURCE = "gpusense"
# Most calls at once.
_MOST_CALLS = 1024
# Seconds between two checks of the cluster, for the scheduler to answer, and for workers to end their jobs.
_LOOK, _ANSWER, _GOODBYE = 1.0, 5.0, 10.0


class DaskExecutor(SupervisedExecutor):
    """Jobs on a Dask cluster, one at a time on each worker, in a process that the worker supervises.

    Workers of a cluster at an address are started by ``GPUSENSE_SWEEP_DEVICE=warp:cuda:0 dask worker ADDRESS
    --nthreads 1 --resources gpusense=1`` for each device. If any worker declares this resource, workers without it
    take no jobs.

    Args:
        address: Address of a scheduler, such as ``"tcp://10.0.0.1:8786"``; None starts a cluster in this process that
            listens on 127.0.0.1 only.
        devices: Devices of a cluster that is started: a selection string for each worker, or the number of workers.
        security: A ``distributed.Security`` with certificates for TLS; None takes the certificates of Dask's
            configuration, if any.
        timeout: Longest time to connect, and to wait for a worker or an answer of the scheduler [s].
        job_timeout: See :class:`ProcessExecutor`.

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
    ) -> None:
        library("distributed", "a sweep on Dask")
        self._patience = checks.real("timeout", timeout, above=0)
        names = device_names(devices) if address is None else []
        super().__init__(_MOST_CALLS, job_timeout)
        self._name, self._numbers = f"gpusense-{secrets.token_hex(8)}", itertools.count()
        # Why the cluster is lost (empty before), and the events for which calls and the watch wait.
        self._lost, self._end, self._calls = "", threading.Event(), set[threading.Event]()
        self._client: Any
        self._cluster: Any
        self._client = self._cluster = None
        try:
            self._connect(address, names, security)
            self.address = str(self._client.scheduler.address)
            workers = self._workers()
            if workers is None:
                raise OSError(f"dask: must have a scheduler that answers, got none at {self.address}")
            self._pinned = any(one.get("resources", {}).get(_RESOURCE) for one in workers.values())
            self.slots = self._usable(workers)
            threading.Thread(target=self._watch, name="gpusense-sweep-watch", daemon=True).start()
        except BaseException:
            self.end()
            raise

    def _connect(self, address: str | None, names: list[str], security: Any) -> None:
        """Start a cluster or connect to the one at the address, and wait for a worker."""
        import distributed
        from distributed.comm import get_address_host_port

        # A discarded client closes itself when it is collected. If that happened during the start of another client, it
        # would wait forever for a lock that this thread holds.
        gc.collect()
        if address is not None:
            try:
                # A client that fails on an address would leave a traceback.
                get_address_host_port(address)
            except ValueError as error:
                rule = "dask: must be an address such as tcp://10.0.0.1:8786"
                raise ValueError(f"{rule}, got {checks.show(address)}: {error}") from None
        try:
            self._cluster = None if address is not None else _local_cluster(names, security)
            target = address if self._cluster is None else self._cluster
            self._client = distributed.Client(target, timeout=self._patience, security=security, set_as_default=False)
            self._client.wait_for_workers(1, timeout=self._patience)
            self._client.register_plugin(_one_start(self._name), name=self._name)
            self.send({})
        except (ImportError, AttributeError, pickle.PickleError) as error:
            raise ImportError(f"dask: every worker must have this version of gpusense, got {error}") from error
        except TypeError as error:
            if "ssl_context" not in str(error):
                raise
            raise ValueError(f"security: must have certificates for TLS, got none for {address}") from error
        except (OSError, TimeoutError) as error:
            rule = f"dask: must have a scheduler with workers at {address or 'the loopback'}"
            raise OSError(f"{rule}, got none in {self._patience:g} s: {checks.show(str(error))}") from error

    def __repr__(self) -> str:
        return f"DaskExecutor({self.address!r}, {self.slots} slots)"

    # ---- the cluster

    def _workers(self) -> Mapping[str, Any] | None:
        """Return the scheduler's list of workers; None if it does not answer."""
        try:
            answer = self._client.sync(self._client.scheduler.identity, n_workers=-1, callback_timeout=_ANSWER)
        except Exception:
            return None
        workers: Mapping[str, Any] = answer["workers"]
        return workers

    def _usable(self, workers: Mapping[str, Any]) -> int:
        return sum(bool(one["resources"].get(_RESOURCE) or not self._pinned) for one in workers.values())

    @property
    def window(self) -> int:
        """Number of jobs to submit at once: jobs waiting at a Dask worker would count as started at its end."""
        return max(self.slots, 1)

    @property
    def dashboard(self) -> str:
        """Address of the dashboard; empty without one."""
        services = self._client.scheduler_info().get("services", {})
        return str(self._client.dashboard_link) if services.get("dashboard") else ""

    @property
    def alive(self) -> bool:
        """Return whether the scheduler is running."""
        return bool(self._client.status == "running" and not self._client.scheduler_comm.comm.closed())

    def _watch(self) -> None:
        """Follow the workers of the cluster until it is lost; no call may wait for a watch that has failed."""
        try:
            self._lose(self._followed())
        except Exception as error:
            _LOG.error("sweep: the workers could not be followed", exc_info=True)
            self._lose(f"the workers could not be followed: {error_text(error)}")

    def _lose(self, reason: str) -> None:
        """End all calls, and accept no further ones."""
        self._lost = self._lost or reason
        self._end.set()
        for done in list(self._calls):
            done.set()

    def _followed(self) -> str:
        """Follow the workers of the cluster until it is lost, and return the reason."""
        answered = present = time.monotonic()
        while not self._end.wait(_LOOK):
            if not self.alive:
                return "the scheduler has ended"
            workers, now = self._workers(), time.monotonic()
            if workers is None:
                if now - answered > self._patience and self.alive:
                    return f"the scheduler has not answered for {self._patience:g} s"
                continue
            before, self.slots, answered = self.slots, self._usable(workers), now
            if self.slots:
                present = now
            elif before:
                _LOG.warning("sweep: no worker is left, waiting %g s for one", self._patience)
            elif now - present > self._patience:
                return f"no worker has been there for {self._patience:g} s"
        return "the executor has been shut down"

    # ---- calls

    def send(self, contents: Mapping[str, Any]) -> None:
        """Send maps and the bytes of logs once to each worker, including workers that join later."""
        self._client.register_plugin(_process(dict(contents)), name=self._name)

    def call(self, function: Callable[..., Any], args: Any, kwargs: Any) -> bytes:
        """Run a function in the process of the next free worker."""
        import cloudpickle
        import distributed

        # Another machine may lack the function's module.
        payload, done = bytes(cloudpickle.dumps((function, args, kwargs))), threading.Event()
        number = next(self._numbers)
        remote = self._client.submit(
            _answer, self._name, payload, self._seconds, key=f"{self._name}-{number}", priority=-number, retries=0,
            **({"resources": {_RESOURCE: 1}} if self._pinned else {}),
        )  # fmt: skip
        self._calls.add(done)
        remote.add_done_callback(lambda _: done.set())
        if not self._lost:
            done.wait()
        self._calls.discard(done)
        if self._lost and not remote.done():
            raise OSError(self._lost)
        try:
            return remote.result(timeout=self._patience)
        except distributed.KilledWorker:
            raise WorkerDied("with its Dask worker", outside=True) from None
        except TimeoutError:
            raise WorkerDied("before its result was fetched", outside=True) from None
        except (CancelledError, distributed.CancelledError):
            raise OSError(self._lost or "the scheduler has lost the job") from None

    # ---- the end

    def end(self) -> None:
        """End the running jobs, and leave the cluster."""
        self._lose("the executor has been shut down")
        # A client without a scheduler would log its failed reconnection.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        if self._client is not None and self.alive:
            # Workers end the processes of this executor; workers that do not answer are not awaited.
            thread = threading.Thread(target=self._say_goodbye, daemon=True)
            thread.start()
            thread.join(_GOODBYE)
        for one in (self._client, self._cluster):
            if one is not None:
                with contextlib.suppress(OSError, TimeoutError):
                    one.close()

    def _say_goodbye(self) -> None:
        with contextlib.suppress(Exception):
            self._client.unregister_worker_plugin(self._name)
            self._client.unregister_scheduler_plugin(self._name)


def _local_cluster(names: list[str], security: Any) -> Any:
    """Start a cluster in this process, with all ports on the loopback."""
    import dask
    import distributed

    common: dict[str, Any] = dict(host=_LOOPBACK, security=security)
    scheduler = {
        "cls": distributed.Scheduler,
        "options": {**common, "port": 0, "dashboard": True, "dashboard_address": f"{_LOOPBACK}:0"},
    }
    options = {**common, "nthreads": 1, "resources": {_RESOURCE: 1}, "memory_limit": 0, "dashboard": False}
    specification = {index: {"cls": distributed.Worker, "options": options} for index in range(len(names))}
    # Workers in this process are never lost, even if the machine sleeps for long.
    with dask.config.set({"distributed.scheduler.worker-ttl": None}):
        cluster = distributed.SpecCluster(
            scheduler=scheduler, workers=specification, silence_logs=50, asynchronous=False, security=security
        )
    for index, worker in cluster.workers.items():
        worker.gpusense_device = names[index]
    return cluster


def _answer(name: str, payload: bytes, seconds: float) -> bytes:
    """Run a call of at most ``seconds`` in the process of the present Dask worker; return the pickle of its answer."""
    import distributed

    dask_worker = distributed.get_worker()
    task = dask_worker.get_current_task()

    def wanted() -> bool:
        """Return whether the task is still wanted; Dask forgets the tasks of a killed client."""
        state = dask_worker.state.tasks.get(task)
        return state is not None and state.state == "executing"

    try:
        answer: bytes = dask_worker.plugins[name].process.call(payload, seconds, wanted)
        return answer
    except BrokenExecutor as error:
        return pickle.dumps((False, error))


def _process(contents: dict[str, Any]) -> Any:
    """Return the plugin of Dask workers that keeps an executor's process, with maps and the bytes of logs."""
    import distributed

    class Process(distributed.WorkerPlugin):  # type: ignore[misc]
        """The process of an executor's jobs on a worker."""

        def setup(self, worker: Any) -> None:
            """Make the process, and write the logs as files, which outlive it."""
            self.folder = tempfile.TemporaryDirectory(prefix="gpusense-sweep-")
            sent = dict(contents)
            for index, (path, content) in enumerate(contents.items()):
                if isinstance(content, bytes):
                    # Only the suffixes are taken from the sender, since they select the format.
                    sent[path] = Path(self.folder.name) / f"{index}{''.join(Path(path).suffixes[-2:])}"
                    sent[path].write_bytes(content)
            self.process = Worker(getattr(worker, "gpusense_device", ""), sent)

        def teardown(self, worker: Any) -> None:
            """End the process, also during a job, and remove the files."""
            self.process.close()
            self.folder.cleanup()

    return Process()


def _one_start(name: str) -> Any:
    """Return the plugin of the scheduler that lets an executor's tasks fail with their Dask worker."""
    import distributed

    class OneStart(distributed.SchedulerPlugin):  # type: ignore[misc]
        """Let Dask repeat no job whose worker has ended: the sweep counts its starts."""

        async def start(self, scheduler: Any) -> None:
            """Keep the scheduler."""
            self.scheduler = scheduler

        def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
            """Allow a job that goes to a worker no further failure."""
            if finish == "processing" and str(key).startswith(f"{name}-"):
                self.scheduler.tasks[key].suspicious = self.scheduler.allowed_failures

    return OneStart()


def security_of(authority: Path, certificate: Path, key: Path) -> Any:
    """Return the TLS settings of a client, from PEM files of the authority, the client and its private key."""
    return library("distributed", "a sweep on Dask").Security(
        tls_ca_file=str(authority), tls_client_cert=str(certificate), tls_client_key=str(key), require_encryption=True
    )
