"""Sweeps: jobs as plain data, run on processes or a Dask cluster, with a table that survives crashes."""

from gpusense.sweeps.cluster import DaskExecutor
from gpusense.sweeps.executors import ProcessExecutor, SerialExecutor
from gpusense.sweeps.job import Job, Store
from gpusense.sweeps.process import JobTimeout, WorkerDied
from gpusense.sweeps.run import Sweep, SweepLost, run
from gpusense.sweeps.table import read_table
from gpusense.sweeps.tasks import read_plan

__all__ = [
    "DaskExecutor",
    "Job",
    "JobTimeout",
    "ProcessExecutor",
    "SerialExecutor",
    "Store",
    "Sweep",
    "SweepLost",
    "WorkerDied",
    "read_plan",
    "read_table",
    "run",
]
