"""Discrete models equal direct look-ups on every backend; learning finds causes, with errors over blocks."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.learning.discrete.table import NAMES, count_pairs

BINS = 989


def test_a_flat_direction_leaves_the_other_standard_errors() -> None:
    """The obstacle is in the last step: both rates end there, and only their sum matters."""
    rng = np.random.default_rng(0)
    expected = np.full(3000, 5 * (1 - 0.5 / 50))
    z, u = expected + rng.normal(0, 0.1, 3000), rng.uniform(size=3000)
    z[u < 0.3] = rng.uniform(0, 5, int((u < 0.3).sum()))
    z[u > 0.9] = np.inf
    fit = gs.DiscreteBeamModel.learn(z, expected, 5.0, 50).fit
    assert fit is not None and fit.converged
    errors = fit.standard_errors
    assert math.isnan(errors["lambda_short"]) and math.isnan(errors["lambda_rand"])
    assert "lambda_short, lambda_rand: the readings do not determine it" in fit.status
    # Fixing either rate removes the flat direction.
    counts, _ = count_pairs(z, expected, 5.0, 50)
    causes = gs.DiscreteBeamModel.learn(z, expected, 5.0, 50).causes
    at = np.array([causes.lambda_short + causes.lambda_rand, causes.p_detect, causes.sigma_hit])
    step = np.diag(1e-3 * at)

    def log_p(x: np.ndarray) -> float:
        return counts.log_likelihood(gs.DiscreteCauses(0.0, *map(float, x)))

    curve = np.array([
        [(log_p(at + a + b) - log_p(at + a - b) - log_p(at - a + b) + log_p(at - a - b)) / (4e-6 * x * y)
         for b, y in zip(step, at, strict=True)] for a, x in zip(step, at, strict=True)
    ])  # fmt: skip
    wanted = np.sqrt(np.diagonal(np.linalg.inv(-curve)))[1:]
    np.testing.assert_allclose([errors["p_detect"], errors["sigma_hit"]], wanted, rtol=0.01)


TRUTH = gs.DiscreteCauses(lambda_short=0.1, lambda_rand=0.02, p_detect=0.9, sigma_hit=0.1)
RANGE_MAX, BINS = 10.0, 40


def draw(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw readings in the middles of bins, from the model's table."""
    rng = np.random.default_rng(seed)
    table = gs.DiscreteBeamModel(TRUTH, RANGE_MAX, BINS)
    rows = rng.integers(4, 36, count)
    steps = np.array([rng.choice(BINS + 1, p=table.probabilities[j]) for j in rows])
    return (steps + 0.5) * RANGE_MAX / BINS, (rows + 0.5) * RANGE_MAX / BINS


def learn(z: np.ndarray, expected: np.ndarray, blocks: np.ndarray | None = None) -> gs.DiscreteFit:
    fit = gs.DiscreteBeamModel.learn(z, expected, RANGE_MAX, BINS, blocks=blocks).fit
    assert fit is not None and fit.converged
    return fit


def test_errors_over_blocks() -> None:
    z, expected = draw(4000, 1)
    z[3] = np.nan
    once = learn(z, expected, np.arange(4000) // 2)
    plain = learn(z, expected)
    assert (once.blocks, plain.blocks) == (2000, 0) and plain.standard_errors == plain.independent_errors
    for name, error in plain.standard_errors.items():
        # Independent readings: errors over 2000 blocks agree within their own error.
        assert once.independent_errors[name] == pytest.approx(error, rel=1e-5)
        assert once.standard_errors[name] == pytest.approx(error, rel=0.15), name
    nine = np.repeat(np.arange(4000), 9)
    repeated = learn(np.repeat(z, 9), np.repeat(expected, 9), nine)
    single = learn(z, expected, np.arange(4000))
    for name, error in single.standard_errors.items():
        # Nine copies of a reading have the information of one, to the precision of differences.
        assert repeated.standard_errors[name] == pytest.approx(error, rel=2e-3), name
        assert repeated.independent_errors[name] == pytest.approx(single.independent_errors[name] / 3, rel=2e-3), name


def test_few_blocks_and_bad_input() -> None:
    z, expected = draw(400, 2)
    assert "standard errors are rough, from 4 blocks" in learn(z, expected, np.arange(400) // 100).status
    rule = "blocks: must be at least 2 with a reading that is not missing, got 1"
    for blocks, error, text in (
        (np.zeros(400, int), ValueError, rule),
        (np.zeros(3, int), ValueError, r"blocks: shape must be \(400,\), got \(3,\)"),
        (np.zeros(400), TypeError, "blocks: must hold integers, got dtype float64"),
    ):
        with pytest.raises(error, match=f"^{text}$"):
            learn(z, expected, blocks)


RANGE, BINS = 4.0, 37
NAN, INF = math.nan, math.inf
# Every class of reading, and ranges next to both ends.
SCAN = [0.0, 1.3, INF, NAN, 3.9, RANGE, -INF, -1.0, 2.2, RANGE + 1, float(np.nextafter(np.float32(RANGE), 0)), 0.4]
TABLES = {
    "separate": gs.DiscreteBeamModel(gs.DiscreteCauses(0.1, 0.02, 0.9, 0.1), RANGE, BINS),
    "shared": gs.DiscreteBeamModel(gs.BeamParameters(sigma_hit=0.3), RANGE, BINS),
    "certain": gs.DiscreteBeamModel(gs.DiscreteCauses(0.3, 0.0, 1.0, 0.0), RANGE, BINS),
}


@functools.cache
def scene() -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray]:
    """Return a corridor with a wall at its end: expected ranges are 0 to 3.9 m ahead, and range_max behind."""
    cells = np.zeros((1, 400), int)
    cells[0, -1] = 100
    poses = np.zeros((60, 3))
    poses[:, 0], poses[:, 1] = np.linspace(1e-3, 3.985, 60), 0.005
    return gs.OccupancyGrid(cells, 0.01), gs.Scanner([0.0] * 8 + [math.pi] * 4, RANGE), poses


def model(table: gs.DiscreteBeamModel, backend: str = "numpy", **options: object) -> gs.BeamModel:
    grid, scanner, _ = scene()
    return gs.BeamModel(grid, scanner, table, backend=backend, **options)


def looked_up(table: gs.DiscreteBeamModel, ranges: list[float], expected: np.ndarray) -> np.ndarray:
    """Return the term of each reading, in the precision of the expected ranges."""
    z = np.broadcast_to(np.array(ranges, expected.dtype), expected.shape)

    def bin_of(r):
        steps = np.minimum((r * expected.dtype.type(BINS / RANGE)).astype(int), BINS - 1)
        return np.where(r >= RANGE, BINS, steps)

    with np.errstate(invalid="ignore"):
        missing = ~(z >= 0)
        i, j = bin_of(np.where(missing, 0, z)), bin_of(expected)
    density = table.log_probabilities[j, i] - np.where(i < BINS, math.log(RANGE / BINS), 0)
    return np.where(missing, 0, density.astype(expected.dtype))


@pytest.mark.long
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_scan_is_the_sum_of_look_ups_on_every_backend(name, precision, backend):
    _, _, poses = scene()
    for specialize in (True, False):
        one = model(TABLES[name], backend, precision=precision, specialize=specialize, temperature=0.5)
        log_p, parts = one.log_likelihood(poses, SCAN, per_beam=True)
        wanted = looked_up(TABLES[name], SCAN, np.asarray(one.expected_ranges(poses)))
        np.testing.assert_array_equal(parts, wanted)
        # A dozen terms, added in the model's precision.
        np.testing.assert_allclose(log_p, 0.5 * wanted.astype(float).sum(axis=1), rtol=8 * np.finfo(precision).eps)
        assert (one.log_likelihood(poses, SCAN) == log_p).all()


@pytest.mark.long_on("warp")
def test_max_readings_depend_on_what_is_expected(backend):
    """A wall ahead makes no return unlikely; with and without a wall, the probability is the table's."""
    _, scanner, poses = scene()
    table = TABLES["separate"]
    one = model(table, backend)
    _, parts = one.log_likelihood(poses, [INF] * scanner.count, per_beam=True)
    near, none = parts[:, 0], parts[:, -1]
    assert (none == np.float32(table.log_probabilities[-1, -1])).all() and (near < none).all()
    assert (one.log_likelihood(poses, [NAN] * scanner.count) == 0).all()
    # Chosen beams count max readings as informative.
    chosen = model(table, backend, beams=3)
    _, parts = chosen.log_likelihood(poses, SCAN, per_beam=True)
    assert (np.count_nonzero(parts, axis=1) == 3).all()


@pytest.mark.long_on("warp")
def test_impossible_readings_are_minus_infinity(backend):
    """Zero noise and no random triggers exclude readings behind the wall and "no return"."""
    _, scanner, poses = scene()
    one = model(TABLES["certain"], backend)
    log_p, parts = one.log_likelihood(poses, [INF] + [NAN] * (scanner.count - 1), per_beam=True)
    assert np.isneginf(log_p).all() and np.isneginf(parts[:, 0]).all() and not np.isnan(parts).any()
    assert np.isfinite(one.log_likelihood(poses, [NAN] * 8 + [INF] * 4)).all()


def simulated(causes: gs.DiscreteCauses, count: int, bins: int = BINS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw readings from the table's rows, uniform within their steps."""
    random = np.random.default_rng(seed)
    expected = random.uniform(0.2, 1.1 * RANGE, count)
    cumulative = np.cumsum(gs.DiscreteBeamModel(causes, RANGE, bins).probabilities, axis=1)
    rows = np.minimum((expected * bins / RANGE).astype(int), bins)
    steps = (random.random(count)[:, None] > cumulative[rows, :-1]).sum(axis=1)
    z = (steps + random.random(count)) * RANGE / bins
    return np.where(steps == bins, INF, z), expected


@pytest.mark.parametrize("truth", [
    gs.DiscreteCauses(0.3, 0.05, 0.85, 0.3), gs.DiscreteCauses(0.05, 0.01, 0.97, 0.05),
    gs.DiscreteCauses(1.0, 0.2, 0.4, 0.2),
])  # fmt: skip
def test_learning_finds_the_causes(truth):
    """Causes are within 4 standard errors (12 normal numbers exceed them once in 1300 runs), and none can improve."""
    z, expected = simulated(truth, 30_000)
    table = gs.DiscreteBeamModel.learn(z, expected, RANGE, BINS)
    fit = table.fit
    assert fit is not None and fit.converged and fit.hits + fit.max == 30_000 and fit.missing == 0
    for name in NAMES:
        assert abs(getattr(table.causes, name) - getattr(truth, name)) < 4 * fit.standard_errors[name], name
    data, _ = count_pairs(z, expected, RANGE, BINS)
    assert fit.log_likelihood == pytest.approx(data.log_likelihood(table.causes), rel=1e-12)
    assert fit.log_likelihood > data.log_likelihood(truth)
    assert fit.trace[-1] == pytest.approx(fit.log_likelihood) and min(np.diff(fit.trace)) > -1e-6
    for name in NAMES:
        for factor in (0.99, 1.01):
            other = table.causes.replace(
                **{name: min(getattr(table.causes, name) * factor, 1.0 if name == "p_detect" else INF)}
            )
            assert data.log_likelihood(other) < fit.log_likelihood
    # Densities rather than probabilities of steps.
    each = table.log_likelihood(z, expected).sum() + fit.hits * math.log(table.width)
    assert each == pytest.approx(fit.log_likelihood, rel=1e-12)


def test_readings_are_counted_by_class_and_step():
    random = np.random.default_rng(1)
    z, expected = random.uniform(-1, 6, 500).astype(np.float32), random.uniform(0, 6, 500)
    z[::7], z[1::11], z[2::13] = NAN, INF, -INF
    whole, _ = count_pairs(z, expected, RANGE, 5)
    wanted: dict[tuple[int, int], int] = {}
    for own, exp in zip(z.tolist(), expected.tolist(), strict=True):
        if own >= 0:
            cell = min(int(min(exp, 5.0) * 1.25), 5), min(int(min(own, 5.0) * 1.25), 5)
            wanted[cell] = wanted.get(cell, 0) + 1
    found = dict(zip(zip(whole.rows.tolist(), whole.steps.tolist(), strict=True), whole.counts.tolist(), strict=True))
    assert (
        found == wanted and whole.missing == np.count_nonzero(~(z >= 0)) and whole.counts.sum() + whole.missing == 500
    )
    again, _ = count_pairs(z.reshape(20, 25), expected.reshape(20, 25), RANGE, 5)
    for one, two in zip(dataclasses.astuple(whole), dataclasses.astuple(again), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(("z", "expected", "unknown"), [
    ([INF] * 50, [1.0] * 50, "sigma_hit"),
    ([INF] * 50, [9.0] * 50, "p_detect"),
    ([1.0] * 50, [1.0] * 50, "sigma_hit"),
    ([0.01] * 50, [3.0] * 50, "sigma_hit"),
    ([2.0], [2.0], "sigma_hit"),
])  # fmt: skip
def test_uninformative_readings_give_finite_causes_and_say_so(z, expected, unknown):
    table = gs.DiscreteBeamModel.learn(z, expected, RANGE, 20)
    assert all(math.isfinite(value) for value in table.causes.to_dict().values())
    assert math.isnan(table.fit.standard_errors[unknown]) and unknown in table.fit.status
    assert math.isfinite(table.fit.log_likelihood) and not np.isnan(table.log_probabilities).any()


CAUSES = gs.DiscreteCauses()
GRID, SCANNER = gs.OccupancyGrid([[0, 0, 100]], 1.0), gs.Scanner([0.0], 5.0)


@pytest.mark.parametrize(("action", "kind", "message"), [
    (lambda: gs.DiscreteBeamModel(CAUSES, 5.0, 3, 1), TypeError, "fit: must be a DiscreteFit or None, got 1"),
    (lambda: gs.DiscreteBeamModel.from_dict({}), ValueError,
     "DiscreteBeamModel: must have the fields kind, causes, range_max, bins, got []"),
    (lambda: gs.DiscreteBeamModel.from_dict({"kind": "x", "causes": {}, "range_max": 1.0, "bins": 3}), ValueError,
     "kind: must be one of 'DiscreteCauses', 'BeamParameters', got 'x'"),
    (lambda: gs.DiscreteBeamModel.learn([1.0], [-1.0], 5.0), ValueError,
     "expected: every value must be >= 0 where the reading is not missing, got -1.0"),
    (lambda: gs.DiscreteBeamModel.learn([NAN], [1.0], 5.0), ValueError,
     "ranges: must have a reading that is not missing, got 1 missing ones"),
    (lambda: gs.BeamModel(GRID, SCANNER, gs.DiscreteBeamModel(CAUSES, 4.0)), ValueError,
     "parameters: must have the scanner's range_max = 5.0, got a DiscreteBeamModel for 4.0"),
    (lambda: gs.BeamModel(GRID, SCANNER, gs.DiscreteBeamModel(CAUSES, 5.0), sensor_table=0.1), ValueError,
     "sensor_table: must be None with a DiscreteBeamModel, got 0.1"),
    (lambda: gs.BeamModel(GRID, SCANNER, gs.DiscreteBeamModel(CAUSES, 5.0), compat="amcl"), ValueError,
     "compat: must be None with a DiscreteBeamModel, got 'amcl'"),
])  # fmt: skip
def test_bad_input(action, kind, message):
    with pytest.raises(kind) as caught:
        action()
    assert str(caught.value) == message
