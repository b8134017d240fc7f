"""Run ``gpusense sweep``: run the jobs of a plan on processes or a Dask cluster, and write a table."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

from gpusense._util import checks
from gpusense._util.progress import progress
from gpusense.commands import output
from gpusense.commands.arguments import BACKEND_HELP, Options, picture, positive_number, whole_number
from gpusense.commands.output import counted

if TYPE_CHECKING:
    from gpusense.sweeps.cluster import DaskExecutor
    from gpusense.sweeps.job import Job
    from gpusense.sweeps.run import Sweep

FIRST = ("table", "processes", "device", "resume", "plot")
SHARED = ("verbose",)
CODES = {1: "some jobs failed", 2: "bad input, or the cluster ended"}

LOCAL = "local"
_TLS = {
    "ca": "certificate of the authority that has signed the cluster's certificates",
    "cert": "certificate of this client",
    "key": "private key of this client",
}

EPILOG = """\
A plan is a YAML file: each combination of its axes is a job. docs/sweeps.md describes it.

A row is appended to the table when its job ends. A failed job is a row with its error; a job that ends its worker or
exceeds --job-timeout fails alone. After a crash or Ctrl-C, --resume runs the jobs without a row.

Jobs run in a separate process; --processes or several --device start several processes, one per device, and --dask uses
a Dask cluster. The cluster 'local' listens on the loopback only. Everyone who reaches the ports of a Dask cluster can
execute code there: use a trusted network or TLS. Maps and logs are sent to the workers once.

examples:
  gpusense sweep examples/sweep_logs.yaml --root data --table sweep.csv \\
      --processes 2 --plot sweep.png
  gpusense sweep plan.yaml --device warp:cuda:0 --device warp:cuda:1
  gpusense sweep plan.yaml --processes 8 --job-timeout 600
  gpusense sweep plan.yaml --dask tcp://10.0.0.1:8786 --resume
  gpusense sweep plan.yaml --dask tls://10.0.0.1:8786 --tls-ca ca.pem \\
      --tls-cert cert.pem --tls-key key.pem"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("PLAN", "the plan, a YAML file", Path)
    add("--table FILE", "the table, .csv or .parquet (default: the plan's name with .csv, in this folder)", Path)
    add("--resume", "keep the rows of an existing table, and run the remaining jobs")
    add("--retry-failed", "with --resume: run failed jobs again")
    add("--root FOLDER", "folder of maps and logs (default: the plan's)", Path)
    add("--dask ADDRESS", "a Dask scheduler, such as tcp://10.0.0.1:8786, or 'local' for a new cluster")
    add("--processes N", "processes, or workers of the local cluster (default: one for each --device)",
        whole_number(low=1))  # fmt: skip
    add("--device DEVICE*", f"{BACKEND_HELP}; repeatable: one worker each")
    for name, what in _TLS.items():
        add(f"--tls-{name} FILE", f"with --dask: {what}, PEM", Path)
    add("--no-send", "with --dask: workers read maps and logs from --root themselves")
    add("--attempts A", "largest number of starts of a job whose worker ends", whole_number(low=1), 3)
    add("--job-timeout SECONDS", "longest time of a job, which then fails, and its worker is replaced (default: none)",
        positive_number)  # fmt: skip
    add("--list", "print the jobs with their keys, and run none")
    add("--plot FILE", "draw error against run time, with a point for each job", picture)


def run(args: argparse.Namespace) -> int:
    """Run the jobs, and print a summary; after Ctrl-C, of the jobs so far."""
    from gpusense.sweeps.tasks import read_plan

    jobs = read_plan(args.plan)
    if args.list:
        return _list(jobs, as_json=args.json)
    if args.retry_failed and not args.resume:
        raise ValueError("--retry-failed: must come with --resume")
    args.root = args.plan.parent if args.root is None else args.root
    args.table = Path(f"{args.plan.stem}.csv") if args.table is None else args.table
    begin = time.perf_counter()
    ended = _swept(args, jobs)
    _report(args, ended, time.perf_counter() - begin)
    return int(ended.failed > 0)


def _list(jobs: tuple[Job, ...], *, as_json: bool) -> int:
    if as_json:
        names = ("key", "task", "map", "log", "model", "seed")
        output.document({"jobs": [
            {name: getattr(job, name) for name in names} | {"options": dict(job.options), "labels": dict(job.labels)}
            for job in jobs
        ]})  # fmt: skip
        return 0
    output.result(counted(len(jobs), "job"))
    for job in jobs:
        texts = [f"{name}={value}" for name, value in job.labels]
        print(job.key, job.task, *(texts or (job.log, job.map, job.model)))
    return 0


def _swept(args: argparse.Namespace, jobs: tuple[Job, ...]) -> Sweep:
    """Run the jobs on the executor of the options."""
    from gpusense.sweeps.run import run as run_jobs

    failures = 0
    with _executor(args, jobs) as executor, progress(len(jobs)) as step:
        step("starting")

        def on_row(row: dict[str, str]) -> None:
            nonlocal failures
            if row["error"]:
                failures += 1
                if failures <= 5:
                    sys.stderr.write(f"gpusense: job {row['key']} failed: {row['error']}\n")
            step(f"{row['model']} {Path(row['log']).name}, {failures} failed")

        # Set the default device of workers.
        backend = args.device[0] if args.device else "auto"
        try:
            return run_jobs(
                jobs, table=args.table, executor=executor, root=args.root, backend=backend, resume=args.resume,
                retry_failed=args.retry_failed, attempts=args.attempts, on_row=on_row,
            )  # fmt: skip
        except ImportError as error:
            raise ValueError(str(error)) from None
        except KeyboardInterrupt:
            sys.stderr.write(f"gpusense: {args.table} has the finished jobs: --resume runs the remaining ones\n")
            raise


@contextlib.contextmanager
def _executor(args: argparse.Namespace, jobs: tuple[Job, ...]) -> Iterator[Executor]:
    """Make the executor from the options, and end it afterwards."""
    from gpusense.sweeps.executors import ProcessExecutor
    from gpusense.sweeps.job import contents_of

    devices: list[str] = args.device or []
    count = args.processes or max(len(devices), 1)
    if args.processes and len(devices) > 1 and len(devices) != count:
        raise ValueError(f"--processes: must be the number of --device, {len(devices)}, got {count}")
    names = devices if len(devices) == count else devices[:1] * count or count
    given = [name for name in _TLS if getattr(args, f"tls_{name}") is not None]
    if given and (args.dask in (None, LOCAL) or len(given) < len(_TLS)):
        rule = "must be given together, and with --dask and an address"
        raise ValueError(f"--tls-ca, --tls-cert, --tls-key: {rule}, got --tls-{given[0]}")
    if args.dask is not None:
        with _dask(args, names) as cluster:
            if args.dask != LOCAL and not args.no_send:
                cluster.send(contents_of(jobs, args.root))
            yield cluster
    else:
        with ProcessExecutor(names, job_timeout=args.job_timeout) as processes:
            yield processes


@contextlib.contextmanager
def _dask(args: argparse.Namespace, names: list[str] | int) -> Iterator[DaskExecutor]:
    from gpusense.sweeps.cluster import DaskExecutor, security_of

    local = args.dask == LOCAL
    try:
        files = [checks.existing_file(one) for one in (args.tls_ca, args.tls_cert, args.tls_key) if one is not None]
        security = security_of(*files) if files else None
        cluster = DaskExecutor(
            None if local else args.dask, devices=names, security=security, job_timeout=args.job_timeout
        )
    except ImportError as error:
        raise ValueError(str(error)) from None
    with cluster:
        shown = f", dashboard {cluster.dashboard}" if cluster.dashboard else ""
        sys.stderr.write(f"gpusense: Dask at {cluster.address}, {cluster.slots} slots{shown}\n")
        yield cluster


def _report(args: argparse.Namespace, ended: Sweep, seconds: float) -> None:
    """Draw the picture, and print the summary."""
    if args.plot is not None and not _drawn(ended.table, args.plot):
        args.plot = None
    if args.json:
        output.report({**vars(ended), "plot": args.plot, "seconds": seconds})
        return
    verdict = "DONE" if not ended.failed else f"{ended.failed} FAILED"
    before = f", {ended.skipped} were in the table before" if ended.skipped else ""
    output.result(f"{verdict}: {ended.done} of {counted(ended.jobs, 'job')} ran in {seconds:.0f} s{before}")
    if ended.failed:
        output.fact("failed", "column 'error' of the table has the reasons; --resume --retry-failed runs them again")
    if ended.repeated:
        output.fact("repeated", f"{ended.repeated} runs ended with their worker and were started again")
    output.files(args.table, args.plot)
    output.details(args)


def _drawn(table: str, path: Path) -> bool:
    """Draw the picture; return whether any job could be drawn."""
    from gpusense.plots.drawing import save
    from gpusense.plots.runs import sweep_figure
    from gpusense.sweeps.table import read_table

    try:
        figure = sweep_figure(read_table(table))
    except ValueError as error:
        sys.stderr.write(f"gpusense: no picture: {error}\n")
        return False
    save(figure, path)
    return True
