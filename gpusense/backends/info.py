"""A device as models see it, and its bond to the process that opened it."""

from __future__ import annotations

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class BackendInfo:
    """A device as a model sees it.

    Attributes:
        selection: The selection string of this device, such as ``"opencl:0:0"``.
        backend: ``"numpy"``, ``"opencl"`` or ``"warp"``.
        name: The device's name.
        kind: ``"cpu"`` or ``"gpu"``.
        driver: Version of the driver or library that compiles for it.
        memory: Bytes of device memory.
        max_buffer: Bytes of the largest buffer.
        float64: Whether float64 kernels exist on it.
        lanes: Particles or beams that a work-item of kernels in lanes computes at once; 1 leaves vectors to the
            compiler.
        vector_loops: Whether the compiler vectorises a work-item's loops over readings rather than over work-items.
        target: The processor for which the driver compiles, by its compiler's name; empty where it is not known.
        graphs: True if the launches and copies of a call are a batch, replayed as one graph once it repeats.

    Example:
        >>> from gpusense.backends import get_backend
        >>> info = get_backend("numpy").info
        >>> info.selection, info.kind, info.float64, info.graphs
        ('numpy', 'cpu', True, False)
    """

    selection: str
    backend: str
    name: str
    kind: str
    driver: str
    memory: int
    max_buffer: int
    float64: bool
    lanes: int = 1
    vector_loops: bool = False
    target: str = ""
    graphs: bool = False


class ProcessBound:
    """A device that is bound to the process that opened it: drivers do not survive a fork."""

    info: BackendInfo

    def __init__(self) -> None:
        self._process = os.getpid()

    def check_process(self) -> None:
        """Refuse a forked child, where the driver would hang or corrupt memory."""
        if os.getpid() != self._process:
            raise RuntimeError(
                f"{self.info.selection} was opened by process {self._process} and does not survive a fork: start "
                "workers with multiprocessing.get_context('spawn') and make their models there"
            )
