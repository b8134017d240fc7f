"""Stored programs of earlier calls are repeated with the numbers of the current call."""

from __future__ import annotations

import numpy as np
import pytest
from support.scan_calls import CASES, COUNT, FIELD, GRID, NEAR, SCANS, cloud

from gpusense.backends import Backend, get_backend
from gpusense.backends.proxy import Proxy
from gpusense.evaluation.tolerances import differing
from gpusense.interface.signatures import KERNELS


class Guards(Proxy):
    """A backend that records the bounds of rounding errors in launches of likelihood fields."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.guards: list[float] = []

    def compile(self, kernel, flags):
        launcher = super().compile(kernel, flags)

        def listed(size, *arguments):
            if kernel == "score_field":
                names = [argument.name for argument in KERNELS[kernel].with_flags(flags).arguments]
                self.guards.append(arguments[names.index("guard")])
            launcher(size, *arguments)

        return listed


@pytest.mark.parametrize("gpu", [False, True])
def test_the_bound_of_rounding_errors_follows_the_longest_reading(backend, gpu, as_gpu):
    """End points of longer readings have larger errors: a stored program takes the scan's bound."""
    as_gpu(gpu)
    device = Guards(get_backend(backend))
    model = FIELD(GRID, NEAR, backend=device)
    lengths = [0.5, 4.0, 0.5, 4.0, 4.01]
    for length in lengths:
        model.log_likelihood(cloud(1), np.full(NEAR.count, length), per_beam=gpu)
    needed = [model._pipeline.guard * (length / GRID.resolution + 2) for length in lengths]
    assert device.guards == pytest.approx(needed, rel=1e-15)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("case", CASES)
def test_scans_of_poses_that_stay_in_place_have_the_bits_of_ordinary_calls(case, backend, monkeypatch):
    """Poses and map change as well, and one scan comes from a list."""
    device, model, scored, once = get_backend(backend), *(CASES[case](backend=backend) for _ in range(3))
    poses = device.view(device.upload(np.zeros(3 * COUNT)), (COUNT, 3), np.dtype(np.float64))
    out = device.view(device.upload(np.zeros(COUNT, model.precision)), (COUNT,), np.dtype(model.precision))
    moved: list[int] = []
    ordinary, run = [], model._run
    monkeypatch.setattr(model, "_run", lambda request: (ordinary.append(request), run(request)))
    for seed, one in enumerate((*SCANS, *SCANS[:3])):
        scan = one[: model.scanner.count]
        if seed == 4:
            for changed in (model, scored, once):
                changed.update_map(np.full((3, 3), 100), (20, 30))
        device.upload(cloud(seed).reshape(-1), poses.buffer)
        model.start_scoring(poses, scan.tolist() if seed == 5 else scan, out=out, before=lambda: moved.append(1))
        model.finish_scoring()
        found = device.download(out.buffer, np.empty(COUNT, model.precision))
        assert differing(found, scored.log_likelihood(cloud(seed), scan)) == 0
        assert len(moved) == seed + 1
    # On processors the first scan, the list, and scans with a constant log-likelihood; on GPUs all.
    most = len(moved) if device.info.kind == "gpu" else 5
    assert 2 <= len(ordinary) <= most or not model._context.possible
    once.start_scoring(poses, scan, out=out)
    assert model.explain() == once.explain() and model.sources() == once.sources()
