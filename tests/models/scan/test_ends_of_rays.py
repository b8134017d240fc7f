"""Rays end behind their readings, where obstacles no longer change the density; results keep all bits."""

from __future__ import annotations

import numpy as np
import pytest

import gpusense as gs
from gpusense.evaluation.tolerances import differing
from gpusense.models.scan import mixture
from gpusense.models.scan.mixture import mixture_of

RANGE = 12.0
PARAMETERS = {
    "no short": gs.BeamParameters(0.8, 0.0, 0.1, 0.1),
    "narrow": gs.BeamParameters(0.8, 0.0, 0.1, 0.1, 0.004),
    "wide": gs.BeamParameters(0.8, 0.0, 0.1, 0.1, 1.0),
    "nearer, growing": gs.BeamParameters(0.8, 0.0, 0.1, 0.1, range_bias=-0.2, sigma_growth=0.02),
    "farther": gs.BeamParameters(0.8, 0.0, 0.1, 0.1, range_bias=0.3),
    "rand alone": gs.BeamParameters(0.0, 0.0, 0.5, 0.5),
    "logarithms": gs.BeamParameters(0.9 - 1e-33, 0.0, 0.1, 1e-33),
    "short, quickly": gs.BeamParameters(lambda_short=6.0),
}


def scene(count: int) -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray, np.ndarray]:
    """Return a sparse map, a scanner, poses all over the map, and a scan with max and missing readings."""
    rng = np.random.default_rng(3)
    grid = gs.OccupancyGrid(rng.choice([0, 100], (150, 170), p=[0.995, 0.005]), 0.1)
    scanner = gs.Scanner(np.linspace(-3, 3, 61), RANGE)
    z = rng.uniform(0, RANGE, 61)
    z[::9], z[4::11] = np.inf, np.nan
    return grid, scanner, rng.uniform((-1, -1, -3), (18, 16, 3), (count, 3)), z


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.12)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", PARAMETERS)
def test_no_bit_changes(name, precision, backend, monkeypatch):
    grid, scanner, poses, z = scene(200)
    found = []
    for ends in (True, False):
        if not ends:
            monkeypatch.setattr(mixture, "_last_range", lambda *_: None)
        model = gs.BeamModel(grid, scanner, PARAMETERS[name], precision=precision, backend=backend)
        log_p, parts = model.log_likelihood(poses, z, per_beam=True)
        found.append((log_p, parts, model.log_likelihood(poses, z)))
        assert ("STOPS" in model._last.flags) == ends
    for one, other in zip(*found, strict=True):
        assert differing(one, other) == 0


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("name", PARAMETERS)
def test_nothing_beyond_the_end_changes_the_density(name, precision):
    """Beyond the end, the density in float64 is constant to a quarter of the precision's last bit."""
    from gpusense.models.scan.densities import log_mixture

    p = PARAMETERS[name]
    flags, terms, _ = mixture_of((p,), RANGE, np.dtype(precision), specialize=True, max_depends=False)
    offset, slope, least = map(float, (*terms.last_offset, *terms.last_slope, *terms.last_least))
    assert "STOPS" in flags and slope >= 1 and offset > 0
    for z in np.linspace(0, RANGE, 40, endpoint=False):
        end = max(offset + slope * z, least)
        if end < RANGE:
            log_p = log_mixture(z, np.linspace(end, RANGE, 400), range_max=RANGE, **p.to_dict())
            assert np.ptp(log_p) <= 0.25 * np.finfo(precision).eps + 4 * np.finfo(float).eps * abs(log_p).max()
    # The end is tight: half an offset nearer, an obstacle matters, unless p_hit is 0.
    if p.z_hit and not p.z_short and slope < 1.01:
        near = log_mixture(2.0, 2.0 + 0.5 * offset - p.range_bias, range_max=RANGE, **p.to_dict())
        far = log_mixture(2.0, RANGE, range_max=RANGE, **p.to_dict())
        assert abs(near - far) > np.finfo(precision).eps or offset < 1e-5 * RANGE
