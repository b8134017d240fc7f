"""Shapes of hits: Student's t against mpmath and SciPy, on every backend; all users follow a made-up shape."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from mpmath import mp
from scipy import stats
from support.paths import ROOT

import gpusense as gs
from gpusense.evaluation.range_data import RangeData, log_densities
from gpusense.evaluation.tolerances import per_beam
from gpusense.models.scan.densities import log_hit, log_mixture
from gpusense.plots import fits
from gpusense.world.hit_shapes import NORMAL, SHAPES, HitShape, StudentHit
from gpusense.world.hit_tables import looked_up, mass_table, quantile_table

FACTOR, DOF = 1.7, 3.0


class MadeUpHit(StudentHit):
    """The shape; kernels get only its numbers."""

    fitted = ()
    limits = ()
    starts = ((0.3,), (1.0,))

    @classmethod
    def of(cls, parameters):
        return cls(DOF)

    @classmethod
    def at(cls, coordinates):
        return cls(DOF)

    @property
    def coordinates(self):
        return np.zeros(0)

    def values(self):
        return {}

    @property
    def log_width(self):
        return super().log_width + math.log(FACTOR)

    @property
    def numbers(self):
        power, rate = super().numbers
        return power, rate / FACTOR**2

    def exponent(self, u):
        return super().exponent(u / FACTOR)

    def slope(self, u):
        return super().slope(u / FACTOR) / FACTOR

    def reach(self, exponent):
        return FACTOR * super().reach(exponent)

    def half_mass(self, u):
        return super().half_mass(np.asarray(u) / FACTOR)

    def quantile(self, level):
        return FACTOR * super().quantile(level)


def made_up(parameters, name="made-up"):
    """Return parameters with hits of the made-up shape."""
    return parameters.replace(hit=name)


def same(parameters):
    """Return parameters of the same density by Student's t."""
    return parameters.replace(hit="student", hit_dof=DOF, sigma_hit=FACTOR * parameters.sigma_hit)


RANGE = 8.0
RNG = np.random.default_rng(3)
GRID = gs.OccupancyGrid(np.where(RNG.random((80, 90)) < 0.02, 100, 0), 0.1)
SCANNER = gs.Scanner.uniform(angle_min=-2, angle_increment=0.1, count=40, range_max=RANGE)
POSES = RNG.uniform((1, 1, -3), (8, 7, 3), (17, 3))
Z = RNG.uniform(0.3, 7.9, 40)
MIXTURES = {
    "book": gs.BeamParameters(),
    "no rand": gs.BeamParameters(0.9, 0.05, 0.05, 0.0, 0.1, 0.3, range_bias=0.03, sigma_growth=0.01),
    "sharp": gs.BeamParameters(0.7, 0.1, 0.1, 0.1, 1e-3, range_bias=-0.6),
    "sharp without rand": gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 1e-4, sigma_growth=0.002),
    "tiny": gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 8e-8),
    "huge": gs.BeamParameters(0.9, 0.0, 0.0, 0.1, 8e6),
}


def exact_tail(dof: float, x: mp.mpf) -> mp.mpf:
    """Return the mass of Student's t beyond x >= 0."""
    n = mp.mpf(dof)
    return mp.betainc(n / 2, mp.mpf(1) / 2, 0, n / (n + x * x), regularized=True) / 2


def exact_log_hit(z: float, expected: float, sigma: float, dof: float) -> mp.mpf:
    """Return the log density of Student's t, truncated to [0, RANGE], with 40 digits."""
    z, e, s, n = map(mp.mpf, (z, expected, sigma, dof))
    u, low, high = (z - e) / s, -e / s, (RANGE - e) / s
    peak = mp.loggamma((n + 1) / 2) - mp.loggamma(n / 2) - mp.log(n * mp.pi) / 2 - mp.log(s)
    if low > 0:
        mass = exact_tail(dof, low) - exact_tail(dof, high)
    elif high < 0:
        mass = exact_tail(dof, -high) - exact_tail(dof, -low)
    else:
        mass = 1 - exact_tail(dof, -low) - exact_tail(dof, high)
    return peak - (n + 1) / 2 * mp.log1p(u * u / n) - mp.log(mass)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("dof", [1.0, 1.5, 4.0, 59.0, 61.0, 300.0])
def test_densities_are_those_of_40_digits(dof):
    places = (-200.0, -3.0, -1e-3, 0.0, 1e-9, 2.0, 7.999, 8.0, 8.1, 30.0)
    with mp.workdps(40):
        for sigma, expected, z in itertools.product((1e-7, 1e-3, 0.1, 3.0, 8e6), places, (0.0, 1e-9, 1.9, 2.0, 8.0)):
            truth = exact_log_hit(z, expected, sigma, dof)
            found = log_hit(z, expected, sigma, RANGE, shape=StudentHit(dof))
            assert abs(found - truth) <= 1e-11 * (1 + abs(truth)), (sigma, expected, z)


def test_pages_and_docstrings_name_every_shape():
    for name in SHAPES.keys() - {"normal"}:
        assert f'hit="{name}"' in (ROOT / "docs" / "models.md").read_text(encoding="utf-8"), name
        for file, times in (("world/parameters.py", 2), ("learning/beam/fit.py", 1)):
            text = (ROOT / "gpusense" / file).read_text(encoding="utf-8")
            assert text.count(f'``"{name}"``') >= times, (name, file)


def test_cauchy_and_other_distributions_of_scipy():
    u = np.concatenate([np.linspace(0, 5, 200), np.geomspace(5, 1e6, 100)])
    for dof in (1.0, 2.5, 7.0, 1e3):
        shape, scipy_shape = StudentHit(dof), stats.t(dof)
        np.testing.assert_allclose(shape.log_pdf(u), scipy_shape.logpdf(u), rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(shape.half_mass(u), 0.5 - scipy_shape.sf(u), rtol=1e-13, atol=1e-15)
        slope = (shape.exponent(u[1:200] + 1e-6) - shape.exponent(u[1:200] - 1e-6)) / 2e-6
        np.testing.assert_allclose(shape.slope(u[1:200]), slope, rtol=1e-8)
        assert shape.reach(float(shape.exponent(np.array([3.7]))[0])) == pytest.approx(3.7)
    np.testing.assert_allclose(StudentHit(1.0).half_mass(u), np.arctan(u) / math.pi, rtol=1e-13)
    np.testing.assert_allclose(NORMAL.log_pdf(u[:100]), stats.norm.logpdf(u[:100]), rtol=1e-13)


@pytest.mark.parametrize("dof", [1.0, 2.7, 40.0, 1e6])
def test_tables_have_the_digits_of_their_precision(dof):
    shape, u = StudentHit(dof), np.geomspace(1e-9, 1e7, 20_000)
    level = np.concatenate([np.geomspace(1e-9, 1, 1000), np.linspace(1, 36, 1000)])
    truth = shape.half_mass(u)
    table = mass_table(shape, np.dtype(np.float64))
    np.testing.assert_allclose(looked_up(table, np.log1p(u / math.sqrt(2))), truth, rtol=1e-13)
    narrow = mass_table(shape, np.dtype(np.float32)).astype(float).reshape(256, 5)
    at = np.log1p(u / math.sqrt(2)) * 16
    cell = np.minimum(at.astype(int), 255)
    inside = at < 256
    powers = (at - cell)[:, None] ** np.arange(5)
    np.testing.assert_allclose((narrow[cell] * powers).sum(axis=1)[inside], truth[inside], rtol=3e-7)
    assert truth[~inside].size == 0 or (0.5 - truth[~inside] < 6e-8).all()
    found = np.expm1(looked_up(quantile_table(shape), level)) * math.sqrt(2)
    np.testing.assert_allclose(found, shape.quantile(level), rtol=1e-9)
    np.testing.assert_allclose(
        shape.half_mass(shape.quantile(level[:1000])), -0.5 * np.expm1(-level[:1000]), rtol=1e-11
    )


@pytest.mark.long
@pytest.mark.sampled(0.25)
@pytest.mark.parametrize("real", ["float32", "float64"])
def test_models_have_the_density_on_every_backend(real, backend):
    cases = list(itertools.product(MIXTURES, (1.0, 3.3, 1e6), (True, False)))
    if backend.startswith("warp"):
        # Each case compiles.
        cases = [("book", 3.3, True), ("sharp without rand", 1.0, False)][real == "float64" :][:1]
    elif backend != "numpy":
        cases = cases[real == "float64" :: 4]
    expected = gs.RayCaster(GRID, RANGE, backend="numpy", precision=real).cast(POSES, SCANNER.bearings)
    kind = np.dtype(real).type
    for name, dof, specialize in cases:
        p = MIXTURES[name].replace(hit="student", hit_dof=dof)
        sigma = p.sigma_hit + p.sigma_growth * expected[5]
        around = np.clip(expected[5] + p.range_bias, 0, RANGE)
        z = np.clip(around + sigma * np.resize([0, -0.5, 1, 2.5, -3.5, 0.01, -1e3, 1e6], 40), 0, 7.999).astype(kind)
        model = gs.BeamModel(GRID, SCANNER, p, backend=backend, precision=real, specialize=specialize)
        log_p, parts = model.log_likelihood(POSES, z, per_beam=True)
        truth = log_mixture(z.astype(float), expected.astype(float), range_max=RANGE, **p.to_dict())
        assert (np.abs(parts - truth) <= per_beam(truth, kind)).all(), (name, dof, specialize)
        assert np.isfinite(log_p).all()


def test_the_field_is_that_of_scipy_and_its_gradient_that_of_differences():
    p = gs.LikelihoodFieldParameters(sigma_hit=0.3, interpolation="bilinear", hit="student", hit_dof=2.5)
    model = gs.LikelihoodFieldModel(GRID, SCANNER, p, backend="numpy", precision="float64")
    flat = gs.LikelihoodFieldModel(
        GRID, SCANNER, p.replace(hit="normal", z_hit=1.0, z_rand=0.0), backend="numpy", precision="float64"
    )
    exponent = -flat.log_likelihood(POSES, Z, per_beam=True)[1] - math.log(0.3) - 0.5 * math.log(2 * math.pi)
    distance = 0.3 * np.sqrt(2 * np.maximum(exponent, 0))
    truth = np.log(0.9 * stats.t.pdf(distance, 2.5, scale=0.3) + 0.1 / RANGE)
    np.testing.assert_allclose(model.log_likelihood(POSES, Z, per_beam=True)[1], truth, rtol=1e-9)
    gradient, step = model.gradient(POSES, Z)[1], 1e-6
    for axis in range(3):
        moved = step * np.eye(3)[axis]
        slope = (model.log_likelihood(POSES + moved, Z) - model.log_likelihood(POSES - moved, Z)) / (2 * step)
        assert np.median(np.abs(slope - gradient[:, axis]) / (1 + np.abs(slope))) < 1e-6


@pytest.mark.long_on("warp")
def test_readings_are_drawn_from_the_density_with_equal_bits(backend):
    room = gs.OccupancyGrid(np.pad(np.zeros((40, 60), int), 1, constant_values=100), resolution=0.1)
    alone = gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 0.2, hit="student", hit_dof=2.5)
    bins = gs.IncidenceParameters(
        (0, 0.5, np.pi / 2), (alone, alone.replace(sigma_hit=0.5, hit_dof=1.0)), alone.replace(hit_dof=30.0)
    )
    cases = {
        "plain": dict(parameters=alone), "wide": dict(parameters=alone.replace(sigma_hit=1e6)),
        "narrow": dict(parameters=alone.replace(sigma_hit=1e-6, hit_dof=1e6)), "bins": dict(incidence=bins),
    }  # fmt: skip
    if backend.startswith("warp"):
        cases = {"bins": cases["bins"]}
    for name, options in cases.items():
        drawn = [
            gs.BeamModel(room, SCANNER, backend=each, precision="float64", **options).sample(
                [(2.0, 1.5, 0.4)] * 2000, 3
            )
            for each in dict.fromkeys((backend, "numpy"))
        ]
        np.testing.assert_array_equal(drawn[0], drawn[-1])
        if name in ("plain", "wide") and backend == "numpy":
            p = options["parameters"]
            center = gs.RayCaster(room, RANGE, backend="numpy", precision="float64").cast(
                [(2.0, 1.5, 0.4)], SCANNER.bearings
            )[0]
            for beam in (0, 17):
                law = stats.t(p.hit_dof, center[beam], p.sigma_hit)
                low, high = law.cdf([0, RANGE])
                share = (law.cdf(drawn[0][:, beam]) - low) / (high - low)
                assert stats.kstest(share, "uniform").pvalue > 1e-5


# ---- a made-up shape: every user of densities must follow it


def users(parameters, field, backend, real):
    """Return all numbers that depend on the density of hits, by user."""
    beams = dict(backend=backend, precision=real)
    plain = gs.BeamModel(GRID, SCANNER, parameters, **beams)
    bilinear = gs.LikelihoodFieldModel(GRID, SCANNER, field.replace(interpolation="bilinear"), **beams)
    gradient = bilinear.gradient(POSES, Z)
    bins = gs.IncidenceParameters((0, 0.7, np.pi / 2), (parameters,) * 2)
    numbers = {
        "log parts": plain.log_likelihood(POSES, Z, per_beam=True)[1],
        "incidence": gs.BeamModel(GRID, SCANNER, incidence=bins, **beams).log_likelihood(POSES, Z),
        "drawn readings": plain.sample(POSES, seed=5), "field": gradient[0], "gradient": gradient[1],
        "information": gradient[2],
    }  # fmt: skip
    if backend != "numpy":
        # Each configuration compiles.
        return numbers
    numbers |= {
        "beam model": plain.log_likelihood(POSES, Z),
        "everything kept": gs.BeamModel(GRID, SCANNER, parameters, specialize=False, **beams).log_likelihood(POSES, Z),
        "sensor table": gs.BeamModel(GRID, SCANNER, parameters, sensor_table=0.1, **beams).log_likelihood(POSES, Z),
        "look-up": gs.BeamModel(
            GRID, SCANNER, parameters, caster=gs.casters.Lookup(36), **beams
        ).log_likelihood(POSES, Z),
    }  # fmt: skip
    for interpolation in ("nearest", "bilinear"):
        each = field.replace(interpolation=interpolation)
        model = gs.LikelihoodFieldModel(GRID, SCANNER, each, **beams)
        numbers[f"field, {interpolation}"] = model.log_likelihood(POSES, Z)
        numbers[f"field parts, {interpolation}"] = model.log_likelihood(POSES, Z, per_beam=True)[1]
        numbers[f"whole field, {interpolation}"] = gs.LikelihoodFieldModel(
            GRID, SCANNER, each, specialize=False, **beams
        ).log_likelihood(POSES, Z)
    return numbers


def users_on_the_host(parameters, field):
    """Return numbers of users without a kernel."""
    expected = np.linspace(0.5, 7.5, 40)
    data = RangeData(Z, expected, None, np.zeros(40, int), RANGE)
    surface = fits.surface_figure(data, parameters)
    model = gs.LikelihoodFieldModel(GRID, SCANNER, field, backend="numpy")
    found = gs.locate_scan(model, Z, resolution=0.2, angle=0.2)
    image = gs.plots.draw_likelihood_field(gs.plots.new_figure(4.0, 3.0).subplots(), GRID, field, range_max=RANGE)
    drawn = gs.worlds.sample_readings(expected, RANGE, parameters, np.random.default_rng(1))
    return {
        "mixture": log_mixture(Z, expected, range_max=RANGE, **parameters.to_dict()),
        "held-out readings": log_densities(parameters, data),
        "surface": surface.axes[0].get_children()[0].get_array(), "score": found.score,
        "search": found.log_likelihood, "picture": image.get_array(), "worlds": np.nan_to_num(drawn, posinf=RANGE),
    }  # fmt: skip


def assert_followed(found, wanted, others, rtol):
    for name, values in wanted.items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(found[name], values, rtol=rtol, atol=rtol * scale, err_msg=name)
        for other in others:
            assert not np.allclose(other[name], values, rtol=rtol, atol=rtol * scale), name


BEAM = gs.BeamParameters(sigma_hit=0.3)
FIELD = gs.LikelihoodFieldParameters(sigma_hit=0.2)


@pytest.mark.long
def test_a_made_up_shape_is_followed_on_every_backend(backend, monkeypatch):
    monkeypatch.setitem(SHAPES, "made-up", MadeUpHit)
    for real in ("float32", "float64") if backend == "numpy" else ("float32",):
        others = []
        if backend == "numpy":
            # Neither the normal of the same scale nor a Student t of that scale.
            others = [users(BEAM, FIELD, backend, real)]
            others.append(users(BEAM.replace(hit="student", hit_dof=3.0), FIELD.replace(hit="student", hit_dof=3.0),
                                backend, real))  # fmt: skip
        found, wanted = (
            users(made_up(BEAM), made_up(FIELD), backend, real),
            users(same(BEAM), same(FIELD), backend, real),
        )
        assert_followed(found, wanted, others, 2e-4 if real == "float32" else 1e-9)


def test_a_made_up_shape_is_followed_on_the_host(monkeypatch):
    monkeypatch.setitem(SHAPES, "made-up", MadeUpHit)
    found = users_on_the_host(made_up(BEAM), made_up(FIELD))
    assert_followed(found, users_on_the_host(same(BEAM), same(FIELD)), [users_on_the_host(BEAM, FIELD)], 1e-9)


def test_a_made_up_shape_is_learned(monkeypatch):
    monkeypatch.setitem(SHAPES, "made-up", MadeUpHit)
    truth = made_up(gs.BeamParameters(0.85, 0.05, 0.05, 0.05, 0.05, 0.4))
    expected = np.random.default_rng(2).uniform(1, 7, 3000)
    z = gs.worlds.sample_readings(expected, RANGE, truth, np.random.default_rng(4))
    fit = gs.fit_beam_parameters(z, expected, RANGE, backend="numpy", hit="made-up")
    assert fit.converged and fit.parameters.hit == "made-up"
    assert fit.parameters.sigma_hit == pytest.approx(0.05, abs=4 * fit.standard_errors["sigma_hit"])
    normal = gs.fit_beam_parameters(z, expected, RANGE, backend="numpy")
    assert fit.log_likelihood > normal.log_likelihood + 30 and normal.parameters.sigma_hit > FACTOR * 0.05


# ---- rules


@pytest.mark.parametrize(
    "attributes",
    [
        dict(fitted=("hit_dof", "hit_skew"), limits=((0.0, 1.0),) * 2, starts=((0.3, 0.0, 1.0),)),
        dict(fitted=("hit_dof",)),
        dict(limits=((0.0, 1.0),)),
        dict(starts=((0.3, 1.0),)),
    ],
)
def test_a_shape_has_at_most_one_fitted_parameter_with_limits_and_starts(attributes):
    with pytest.raises(TypeError, match="Odd: must have at most one fitted parameter"):
        type("Odd", (HitShape,), attributes)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: gs.BeamParameters(hit="no such shape"), "hit: must be one of"),
        (lambda: gs.BeamParameters(hit="student", hit_dof=0.5), "hit_dof: must be finite and >= 1"),
        (lambda: gs.BeamModel(GRID, SCANNER, gs.BeamParameters(hit="student"), compat="amcl", backend="numpy"),
         "hit: must be 'normal' with compat"),
        (lambda: gs.LikelihoodFieldModel(
            GRID, SCANNER, gs.LikelihoodFieldParameters(hit="student"), compat="beluga", backend="numpy"),
         "hit: must be 'normal' with compat"),
        (lambda: gs.BeamModel(
            GRID, SCANNER, backend="numpy",
            incidence=gs.IncidenceParameters((0, 1, np.pi / 2), (BEAM, BEAM.replace(hit="student")))),
         "hit: must be the same for all angles of incidence"),
        (lambda: gs.DiscreteBeamModel(BEAM.replace(hit="student"), range_max=RANGE), "causes: hit must be 'normal'"),
        (lambda: gs.fit_beam_parameters(Z, Z, RANGE, backend="numpy", hit="student", method="em-book"),
         "hit: must be 'normal' with method 'em-book'"),
        (lambda: gs.fit_beam_parameters(Z, Z, RANGE, backend="numpy", initial=BEAM.replace(hit="student")),
         "initial: hit must be 'normal'"),
    ],
)  # fmt: skip
def test_what_a_shape_cannot_be_used_for_is_refused(make, text):
    with pytest.raises(ValueError, match=text):
        make()


def test_parameters_are_kept_in_mappings():
    p = gs.BeamParameters(hit="student", hit_dof=2.5)
    assert gs.BeamParameters.from_dict(p.to_dict()) == p and p.to_dict()["hit_dof"] == 2.5
    assert not {"hit", "hit_dof"} & gs.BeamParameters().to_dict().keys()
    assert "hit='student', hit_dof=2.5" in repr(p)
    assert ", hit" not in repr(gs.LikelihoodFieldParameters())
