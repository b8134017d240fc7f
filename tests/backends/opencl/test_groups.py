"""Work-groups on OpenCL devices with small limits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.scan_calls import GRID, SCANNER, cloud, scan

import gpusense as gs


@pytest.mark.parametrize("limit", [1, 24])
def test_groups_shrink_to_the_limit_of_a_kernel(as_gpu, monkeypatch, limit):
    """A kernel with many registers gets smaller groups, with the same results."""
    import pyopencl as cl

    expected = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    as_gpu._launchers.clear()
    groups, enqueue = set(), cl.enqueue_nd_range_kernel
    monkeypatch.setattr(cl.Kernel, "get_work_group_info", lambda kernel, name, device: limit)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *launch: (groups.add(launch[3][0]), enqueue(*launch))[1])
    found = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    assert max(groups) == limit
    np.testing.assert_array_equal(found, expected)


def test_groups_fill_the_vectors_of_llvmpipe(as_gpu, monkeypatch):
    """Lanes without a work-item would continue in loops; see ``group_multiple``."""
    import pyopencl as cl

    # Scalar kernels of a processor in groups of 1, 16 and 64 work-items.
    monkeypatch.setattr(as_gpu, "info", dataclasses.replace(as_gpu.info, kind="cpu"))
    expected = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    as_gpu._launchers.clear()
    groups, enqueue = set(), cl.enqueue_nd_range_kernel
    monkeypatch.setattr(cl.Device, "name", property(lambda device: "llvmpipe (LLVM 15.0.6, 256 bits)"))
    monkeypatch.setattr(cl.Kernel, "get_work_group_info", lambda kernel, name, device: 32)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *launch: (groups.add(launch[3][0]), enqueue(*launch))[1])
    found = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    assert groups == {32}
    np.testing.assert_array_equal(found, expected)
