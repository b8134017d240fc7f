"""Start a Dask cluster in this process, and read the certificates of a remote one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gpusense.sweeps import on_worker

LOOPBACK = "127.0.0.1"
# Resource of a Dask worker that represents its device; a job takes one.
RESOURCE = "gpusense"
ABSENT = "dask: must be installed for this executor: pip install 'gpusense[sweep]'"


def local_cluster(names: list[str], security: Any) -> Any:
    """Start a cluster in this process, with all ports on the loopback; its workers supervise processes."""
    import dask
    import distributed

    common: dict[str, Any] = dict(host=LOOPBACK, security=security)
    scheduler = {
        "cls": distributed.Scheduler,
        "options": {**common, "port": 0, "dashboard": True, "dashboard_address": f"{LOOPBACK}:0"},
    }
    options = {**common, "nthreads": 1, "resources": {RESOURCE: 1}, "memory_limit": 0, "dashboard": False}
    specification = {index: {"cls": distributed.Worker, "options": options} for index in range(len(names))}
    # Workers in this process are never lost, even if the machine sleeps for long.
    with dask.config.set({"distributed.scheduler.worker-ttl": None}):
        cluster = distributed.SpecCluster(
            scheduler=scheduler, workers=specification, silence_logs=50, asynchronous=False, security=security
        )
    on_worker.DEVICES.update({worker.id: names[index] for index, worker in cluster.workers.items()})
    return cluster


def security_of(authority: Path, certificate: Path, key: Path) -> Any:
    """Return the TLS settings of a client, from files in PEM.

    Args:
        authority: Certificate of the authority that has signed the cluster's certificates.
        certificate: Certificate of the client.
        key: Private key of the client.

    Raises:
        ImportError: Dask is not installed.
    """
    try:
        import distributed
    except ImportError as error:
        raise ImportError(ABSENT) from error
    return distributed.Security(
        tls_ca_file=str(authority), tls_client_cert=str(certificate), tls_client_key=str(key), require_encryption=True
    )
