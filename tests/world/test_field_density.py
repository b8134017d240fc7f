"""The density of a likelihood field has one home on the host: tables, numbers of kernels, searches, plots follow it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

import gpusense as gs
from gpusense.world.field_density import FieldDensity

CELLS = np.pad(np.zeros((30, 40), int), 1, constant_values=100)
CELLS[10:14, 20:23] = 100
GRID = gs.OccupancyGrid(CELLS, 0.1)
SCANNER = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.2, count=31, range_max=6.0)
POSES = np.random.default_rng(2).uniform((0.5, 0.5, -3), (3.5, 2.5, 3), (40, 3))
RANGES = gs.RayCaster(GRID, range_max=6.0, backend="numpy").cast([[1.0, 1.0, 0.3]], SCANNER.bearings)[0].astype(float)


def parameters(sigma=0.1, **values):
    return gs.LikelihoodFieldParameters(sigma_hit=sigma, max_distance=1.0, **values)


def test_the_density_is_that_of_a_normal_and_a_uniform_one():
    distance = np.array([0.0, 0.05, 0.3, 2.0, 9.0])
    density = FieldDensity(parameters(z_hit=0.8, z_rand=0.2), 6.0)
    truth = 0.8 * stats.norm.pdf(distance, scale=0.1) + 0.2 / 6.0
    np.testing.assert_allclose(np.exp(density.log(distance)), truth, rtol=1e-14)
    assert density.peak == pytest.approx(math.exp(density.log_peak)) == pytest.approx(truth[0] - 0.2 / 6.0)
    assert density.capped(distance).tolist() == [0.0, 0.05, 0.3, 1.0, 1.0]
    with np.errstate(all="raise"):
        assert FieldDensity(parameters(z_hit=0.0, z_rand=1.0), 6.0).log(distance).tolist() == [-math.log(6.0)] * 5
        assert FieldDensity(parameters(z_hit=1.0, z_rand=0.0), 6.0).log(np.array([math.inf])).tolist() == [-math.inf]


def shown(sigma, interpolation, precision, specialize):
    """Return all results that depend on the density: likelihoods, gradients, a search, a picture."""
    p = parameters(sigma, z_hit=0.8, z_rand=0.2, interpolation=interpolation)
    model = gs.LikelihoodFieldModel(
        GRID, SCANNER, p, backend="numpy", precision=precision, specialize=specialize, outside="free"
    )
    found = gs.locate_scan(model, RANGES, resolution=0.1, angle=0.1, refine=False)
    image = gs.plots.draw_likelihood_field(gs.plots.new_figure(4.0, 3.0).subplots(), GRID, p, range_max=6.0)
    numbers = {
        "log p": model.log_likelihood(POSES, RANGES),
        "pose": found.pose, "score": found.score, "search": found.log_likelihood, "picture": image.get_array(),
    }  # fmt: skip
    if interpolation == "bilinear":
        numbers["gradient"], numbers["information"] = model.gradient(POSES, RANGES)[1:]
    return numbers


@pytest.mark.parametrize(
    ("interpolation", "precision", "specialize"),
    [("nearest", "float32", True), ("nearest", "float64", False), ("bilinear", "float64", True)],
)
def test_a_made_up_shape_is_followed_by_all_users(interpolation, precision, specialize, monkeypatch):
    """Hits have 2.5 times the deviation of the parameters: every user must follow."""
    plain = shown(0.1, interpolation, precision, specialize)
    wider = shown(0.25, interpolation, precision, specialize)
    monkeypatch.setattr(FieldDensity, "sigma", property(lambda self: 2.5 * self.parameters.sigma_hit))
    made_up = shown(0.1, interpolation, precision, specialize)
    for name, values in wider.items():
        np.testing.assert_array_equal(made_up[name], values, err_msg=name)
        if name != "pose":
            assert not np.array_equal(plain[name], values), name
