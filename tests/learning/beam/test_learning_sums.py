"""Sums for learning against mpmath, against the densities, and equal on every backend."""

from __future__ import annotations

import itertools

import mpmath as mp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from support.kernel_scenes import PRECISIONS
from support.learning_data import RANGE_MAX, TYPICAL, draw, point, problem_of

from gpusense.evaluation.tolerances import TOLERANCES, per_beam
from gpusense.learning.beam.pairs import BIAS, FORM, SIGMA, Point
from gpusense.learning.beam.problem import Prior
from gpusense.models.scan.densities import log_mixture
from gpusense.world.hit_shapes import StudentHit

POINTS = {
    "ordinary": point(0.6, 0.2, 0.05, 0.15, sigma=0.2, rate=0.4),
    "truncated": point(0.5, 0.3, 0.1, 0.1, sigma=4.0, rate=0.05, bias=0.03),
    "hardly short": point(0.8, 1e-6, 0.1, 0.1 - 1e-6, sigma=0.05, rate=1e-3, bias=-0.02),
    "steep": point(0.3, 0.3, 0.2, 0.2, sigma=0.01, rate=40.0),
    "student": point(0.6, 0.2, 0.05, 0.15, sigma=0.2, rate=0.4, bias=0.01, shape=StudentHit(3.0)),
    "truncated student": point(0.5, 0.3, 0.1, 0.1, sigma=3.0, rate=0.05, bias=0.03, shape=StudentHit(1.0 / 0.7)),
}
PAIRS = ([4.1, 2.0, 9.9, 0.3, 7.0, np.inf, 5.0, np.inf, np.nan], [4.0, 6.0, 9.5, 0.4, 9.9, 8.0, 5.0, 1.0, 3.0])
PRIOR = Prior(np.array([3.0, 2.0, 1.0, 0.5]), 0.3, 0.7, 0.01)


def density_of_hit(u: mp.mpf, form: mp.mpf | None) -> mp.mpf:
    """Return the density of a hit of scale 1: a normal, or Student's t with 1 / form degrees of freedom."""
    if form is None:
        return mp.npdf(u)
    n = 1 / form
    return mp.gamma((n + 1) / 2) / mp.gamma(n / 2) / mp.sqrt(n * mp.pi) * (1 + u * u / n) ** (-(n + 1) / 2)


def mass_of_hit(low: mp.mpf, high: mp.mpf, form: mp.mpf | None) -> mp.mpf:
    """Return its mass between two points."""
    if form is None:
        return mp.ncdf(high) - mp.ncdf(low)
    below, above = (
        mp.sign(u) * mp.betainc(mp.mpf(1) / 2, 1 / form / 2, 0, u * u / (1 / form + u * u), regularized=True) / 2
        for u in (low, high)
    )
    return above - below


def exact_objective(z: list[float], expected: list[float], prior: Prior | None, x: list[mp.mpf]) -> mp.mpf:
    """Return log-likelihood and prior at (log weights, log sigma, log rate, bias, form) by mpmath."""
    total = sum(mp.exp(log) for log in x[:4])
    hit, short, top, rand = (mp.exp(log) / total for log in x[:4])
    sigma, rate, bias, form = mp.exp(x[4]), mp.exp(x[5]), x[6], x[7] if len(x) > 7 else None
    found = mp.mpf(0)
    for reading, ahead in zip(map(mp.mpf, z), map(mp.mpf, expected), strict=True):
        if mp.isnan(reading):
            continue
        if reading >= RANGE_MAX:
            found += mp.log(top)
            continue
        mean = ahead + bias
        mass = mass_of_hit(-mean / sigma, (RANGE_MAX - mean) / sigma, form)
        p = hit * density_of_hit((reading - mean) / sigma, form) / sigma / mass + rand / RANGE_MAX
        if reading <= ahead:
            p += short * rate * mp.exp(-rate * reading) / -mp.expm1(-rate * ahead)
        found += mp.log(p)
    if prior is not None:
        a = [mp.mpf(float(count)) for count in prior.counts]
        found += sum(count * mp.log(weight) for count, weight in zip(a, (hit, short, top, rand), strict=True))
        found -= a[0] * ((prior.sigma**2 + (bias - prior.bias) ** 2) / (2 * sigma**2) + mp.log(sigma))
        found += a[1] * (mp.log(rate) - rate / prior.rate)
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "prior"), [*((name, None) for name in POINTS), ("truncated", PRIOR)], ids=[*POINTS, "with a prior"]
)
def test_derivatives_are_those_of_the_log_likelihood(name: str, prior: Prior | None) -> None:
    at = POINTS[name]
    z, expected = PAIRS
    problem = problem_of(np.array(z), np.array(expected), **({} if prior is None else {"prior": prior}))
    value = problem.value(at, second=True)
    x = [mp.log(mp.mpf(float(weight))) for weight in at.weights]
    x += [mp.log(mp.mpf(at.sigma)), mp.log(mp.mpf(at.rate)), mp.mpf(at.bias), *map(mp.mpf, at.shape.coordinates)]
    with mp.workdps(50):
        exact = float(exact_objective(z, expected, prior, x))
        gradient, hessian = np.empty(len(x)), np.empty((len(x), len(x)))

        def along(*places: int) -> mp.mpf:
            def moved(*steps: mp.mpf) -> mp.mpf:
                y = list(x)
                for place, step in zip(places, steps, strict=True):
                    y[place] += step
                return exact_objective(z, expected, prior, y)

            return mp.diff(moved, (0,) * len(places), (1,) * len(places), h=mp.mpf(10) ** -15)

        for i in range(len(x)):
            gradient[i] = along(i)
            for j in range(i):
                hessian[i, j] = hessian[j, i] = along(i, j)

            def one(step: mp.mpf, i: int = i) -> mp.mpf:
                return exact_objective(z, expected, prior, [*x[:i], x[i] + step, *x[i + 1 :]])

            hessian[i, i] = mp.diff(one, 0, 2, h=mp.mpf(10) ** -15)
    assert value.hessian is not None
    assert value.objective == pytest.approx(exact, rel=1e-13, abs=1e-13)
    # Sums of seven pairs lose a few eps of their largest terms, which grow with 1 / sigma^2 for the bias.
    unit = np.where(np.arange(len(x)) == BIAS, 1 / at.sigma, 1.0)
    off = np.abs((value.gradient - gradient) / unit)
    assert off[:FORM].max() < 1e-11 * (1 + np.abs(gradient / unit).max())
    scaled = np.outer(unit, unit)
    bent = np.abs((value.hessian - hessian) / scaled)
    assert bent[:FORM, :FORM].max() < 1e-11 * (1 + np.abs(hessian / scaled).max())
    # Derivatives by the shape are finite differences.
    assert off[FORM:].max(initial=0) < 1e-5 * (1 + np.abs(gradient / unit).max())
    assert bent[FORM:].max(initial=0) < 1e-5 * (1 + np.abs(hessian / scaled).max())


def alike(found: np.ndarray, truth: np.ndarray, precision: type) -> bool:
    """Return whether sums agree with the reference within the tolerance."""
    # Terms have either sign; their magnitudes are at most some 30 times those of r u^2.
    scale = np.maximum(np.abs(truth), np.abs(truth[7]))[: len(found)]
    tolerance = TOLERANCES[f"{np.dtype(precision).name} sums to learn from"]
    return bool((np.abs(found - truth[: len(found)]) <= tolerance.value * scale).all())


def test_pseudo_readings_of_a_student_are_distributed_as_its_density() -> None:
    prior = Prior(np.array([3.0, 0.0, 0.0, 0.0]), 0.3, 1.0, 0.01, StudentHit(2.5))
    at = point(1.0, 0.0, 0.0, 0.0, sigma=0.2, rate=1.0, bias=0.05, shape=StudentHit(4.0))

    def value(sigma: float, bias: float) -> float:
        law = stats.t(2.5, prior.bias, prior.sigma)

        def density(x: float) -> float:
            return float(law.pdf(x) * stats.t.logpdf(x, 4.0, bias, sigma))

        parts = [quad(density, low, high, epsabs=1e-12, limit=200)[0]
                 for low, high in itertools.pairwise((-np.inf, -5, 0, 0.1, 5, np.inf))]  # fmt: skip
        return 3.0 * sum(parts)

    assert prior.value(at) == pytest.approx(value(0.2, 0.05), rel=1e-8)
    first, second = prior.derivatives(at)
    step = 1e-3
    for place, moved in ((SIGMA, lambda s: (0.2 * np.exp(s), 0.05)), (BIAS, lambda s: (0.2, 0.05 + 0.2 * s))):
        unit = 1.0 if place == SIGMA else 0.2
        before, after = (value(*moved(sign * step)) for sign in (-1, 1))
        assert first[place] * unit == pytest.approx((after - before) / (2 * step), rel=1e-4)
        bend = (after - 2 * value(0.2, 0.05) + before) / step**2
        assert second[place, place] * unit**2 == pytest.approx(bend, rel=1e-2)
    # The prior is highest at the density of the pseudo-readings.
    same = point(1.0, 0.0, 0.0, 0.0, sigma=0.3, rate=1.0, bias=0.01, shape=StudentHit(2.5))
    np.testing.assert_allclose(prior.derivatives(same)[0], 0, atol=1e-7)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("name", ["ordinary", "student"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_sums_are_alike_on_every_backend(precision: type, name: str, backend: str) -> None:
    z, expected = draw(TYPICAL, 3001, 3)
    at = POINTS[name]
    truth = problem_of(z, expected).device.sums(at, information=True)
    found = problem_of(z, expected, backend=backend, real=precision).device.sums(
        at, information=precision is np.float64
    )
    assert alike(found, truth, precision)


def test_log_likelihood_and_responsibilities_are_those_of_the_densities(backend: str) -> None:
    z, expected = draw(TYPICAL, 999, 4)
    hits = np.isfinite(z)
    at = POINTS["truncated"]
    at = Point(at.weights, at.sigma, at.rate)
    problem = problem_of(z, expected, backend=backend)
    parts = at.parameters().to_dict()
    log_p = log_mixture(z, expected, range_max=RANGE_MAX, **parts)
    assert problem.value(at).log_likelihood == pytest.approx(log_p.sum(), rel=1e-12)
    causes = problem.device.causes(at)
    assert (np.abs(causes[:, 0] - log_p[hits]) <= per_beam(log_p[hits], np.float64)).all()
    np.testing.assert_allclose(causes[:, 1:].sum(axis=1), 1, rtol=1e-14)
    for column, name in ((1, "z_hit"), (2, "z_short"), (3, "z_rand")):
        alone = dict.fromkeys(("z_hit", "z_short", "z_max", "z_rand"), 0.0) | {name: parts[name]}
        own = log_mixture(z[hits], expected[hits], range_max=RANGE_MAX, **(parts | alone))
        np.testing.assert_allclose(causes[:, column], np.exp(own - log_p[hits]), rtol=1e-11, atol=1e-300)


def test_sums_do_not_depend_on_how_pairs_are_cut(as_gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    z, expected = draw(TYPICAL, 4000, 6)
    device = as_gpu(False)
    whole = problem_of(z, expected, backend=device).device.sums(POINTS["ordinary"])
    as_gpu(True)
    monkeypatch.setattr("gpusense.learning.beam.device_sums._CHUNK", 700)
    cut = problem_of(z, expected, backend=device).device.sums(POINTS["ordinary"])
    np.testing.assert_allclose(cut, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())
    again = problem_of(z, expected, backend=device).device.sums(POINTS["ordinary"])
    assert (cut == again).all()


def test_a_held_mean_does_not_move_with_the_bias() -> None:
    # z* + b is clamped to range_max, so only the second pair depends on b.
    problem = problem_of(np.array([9.0, 5.0]), np.array([9.8, 5.0]))
    alone = problem_of(np.array([5.0]), np.array([5.0]))
    at = point(0.9, 0.0, 0.0, 0.1, sigma=0.5, rate=1.0, bias=0.4)
    assert problem.value(at).gradient[BIAS] == alone.value(at).gradient[BIAS] != 0


def test_extremes_underflow_nowhere(backend: str) -> None:
    """Readings a million sigmas away, weights of 0 and z* = 0 leave finite sums."""
    z, expected = np.array([0.0, 9.99, 5.0, 3.0, 1e-300]), np.array([0.0, 1.0, 5.0, 1e-310, 10.0])
    problem = problem_of(z, expected, backend=backend)
    for weights in ((0.5, 0.25, 0, 0.25), (1.0, 0, 0, 0), (0, 0, 0, 1.0)):
        for sigma, rate in ((1e-5, 1e4), (10.0, 1e-4)):
            value = problem.value(point(*weights, sigma=sigma, rate=rate), second=True)
            assert np.isfinite(value.log_likelihood) and value.hessian is not None
            assert np.isfinite(value.gradient).all() and np.isfinite(value.hessian).all()
    impossible = problem.value(point(0, 1.0, 0, 0, sigma=1.0, rate=1.0))
    assert impossible.log_likelihood == -np.inf


def test_threads_share_the_blocks_with_the_same_bits(needs, monkeypatch: pytest.MonkeyPatch) -> None:
    z, expected = draw(TYPICAL, 3001, 3)
    device = problem_of(z, expected, backend=needs("warp")).device
    sums, causes = device.sums(POINTS["ordinary"]), device.causes(POINTS["ordinary"])
    monkeypatch.setattr("gpusense.backends.warp.pieces._PIECE_WORK", 64)
    assert (device.sums(POINTS["ordinary"]) == sums).all()
    assert (device.causes(POINTS["ordinary"]) == causes).all()
