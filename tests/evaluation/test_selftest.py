"""The table of tolerances, the replay of launches in float64, and the command that holds backends to them."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.numpy.backend import NumpyBackend
from gpusense.commands.cli import main
from gpusense.evaluation import selftest, stiff
from gpusense.evaluation.replay import Recorder, replay
from gpusense.evaluation.tolerances import (
    TOLERANCES,
    Check,
    beam_tolerance,
    differing,
    per_beam,
    per_scan,
    scan_tolerance,
)
from gpusense.interface.signatures import KERNELS
from gpusense.interface.structs import Score
from gpusense.models.scan import tiles
from gpusense.reference import beam, distance, echo, mixture, order, ranges, sums
from gpusense.reference.error_free import block_sums, strand_sums

INCIDENCE = gs.IncidenceParameters((0, 0.4, 1.0, math.pi / 2), (gs.BeamParameters(),) * 2 + (
    gs.BeamParameters(0.2, 0.1, 0.5, 0.2),))  # fmt: skip
EPS = float(np.finfo(np.float32).eps)


def others() -> list[str]:
    """Return the backends that are present besides NumPy."""
    found = [d for d in gs.devices() if d.available and d.kind != "simulator" and d.backend != "numpy"]
    if not found:
        pytest.skip("only NumPy is here")
    return [device.selection for device in found]


def run(capsys, *arguments):
    code = main(["selftest", *arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


# ---- tolerances


def test_tolerances_are_those_of_the_definitions_and_have_reasons():
    expected = {
        "distance transform": 0,
        "float32 ranges": 0,
        "float64 ranges": 1e-12,
        "float32 ranges to float64": 1e-3,
        "float32 beam": 16,
        "float64 scan": 1e-11,
        "float32 scan, K = 1000": 2e-3,
        "float32 scan, K = 10 000": 1e-2,
        "field look-ups": 0,
    }
    assert {name: TOLERANCES[name].value for name in expected} == expected
    assert all(len(t.reason) > 20 and t.unit for t in TOLERANCES.values())
    assert scan_tolerance("float32", 1000).value == 2e-3
    assert scan_tolerance("float32", 1001).value == 1e-2
    with pytest.raises(ValueError, match="beams: must be <= 10000"):
        scan_tolerance("float32", 10_001)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 1000, 10_000])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("plainly", [block_sums, strand_sums])
def test_per_scan_bound_holds_for_perturbed_beams(plainly, scale, count):
    """Worst-case errors of all beams, summed in float32 as kernels do, stay within the bound."""
    random = np.random.default_rng(count)
    truth = random.normal(-2, 3, (20, count)) * scale
    for sign in (1, -1, random.choice([-1, 1], truth.shape)):
        wrong = truth + 0.9 * sign * per_beam(truth, np.float32)
        found = beam.sum_terms(frozenset(), wrong.astype(np.float32), Score(np.float32(-7), np.float32(0.5)), plainly)
        exact = 0.5 * (np.array([math.fsum(row) for row in truth]) - 7)
        bound = per_scan(truth, np.float32, fixed=-7, temperature=0.5)
        assert (np.abs(found - exact) <= bound).all()


def test_differences_notice_signs_nan_and_infinities():
    assert differing([0.0, 1.0, np.nan], [0.0, 1.0, np.nan]) == 0
    assert differing([0.0], [-0.0]) == 1
    assert differing(np.zeros(3, np.float32), np.zeros(3)) == 3
    beams = beam_tolerance("float32")
    assert beams.difference([-1.0, -np.inf], [-1.0, -np.inf]) == 0
    for found, truth in ((np.nan, 0), (0, np.nan), (-np.inf, 0), (0, -np.inf), (np.inf, -np.inf)):
        assert beams.difference([found], [truth]) == np.inf
    assert beams.difference([3 + 4 * EPS], [3.0]) == pytest.approx(1)
    assert TOLERANCES["float32 angles of incidence"].difference([3 * EPS], [0.0]) == pytest.approx(3)
    assert TOLERANCES["float64 ranges"].difference([2.0 + 2e-12], [2.0]) == pytest.approx(1e-12, rel=1e-3)
    assert scan_tolerance("float32", 10).difference([1.5], [1.0]) == 0.5
    assert TOLERANCES["float32 ranges"].difference([np.float32(1)], [np.nextafter(np.float32(1), np.float32(2))]) == 1


# ---- replay


@pytest.fixture(scope="module")
def scene():
    return selftest.built_in_scene()


def test_scene_has_the_hard_cases(scene):
    kinds = gs.classify(scene.ranges, scene.scanner)
    assert set(kinds.tolist()) == set(gs.Reading)
    cells = scene.grid.world_to_cells(scene.poses[:, :2])
    col, row = np.floor(cells).astype(int).T
    inside = (col >= 0) & (row >= 0) & (col < scene.grid.shape[1]) & (row < scene.grid.shape[0])
    assert np.count_nonzero(~inside) > 10
    assert scene.grid.occupied[row[inside], col[inside]].any()
    assert np.count_nonzero((cells == np.floor(cells)).all(axis=1)) >= 40


@pytest.mark.sampled(1)
@pytest.mark.parametrize("specialize", [True, False])
@pytest.mark.parametrize("temperature", [1.0, 0.25])
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    "make, parameters",
    [
        (gs.BeamModel, gs.BeamParameters()),
        (gs.BeamModel, gs.BeamParameters(z_hit=0.9, z_short=0.1, z_max=0.0, z_rand=0.0)),
        (gs.LikelihoodFieldModel, gs.LikelihoodFieldParameters(z_hit=0.85, z_max=0.05)),
        (gs.LikelihoodFieldModel, gs.LikelihoodFieldParameters(interpolation="bilinear")),
        (gs.BeamModel, INCIDENCE),
    ],
)
def test_replay_agrees_with_numpy(scene, make, parameters, precision, temperature, specialize):
    recorder = Recorder(get_backend("numpy"))
    scanner, own = scene.scanner, {"parameters": parameters}
    if parameters is INCIDENCE:
        scanner, own = selftest.sonar_of(scanner), {"incidence": parameters}
    model = make(scene.grid, scanner, **own, backend=recorder, precision=precision, temperature=temperature,
                 specialize=specialize)  # fmt: skip
    log_p, parts = model.log_likelihood(scene.poses[::3], scene.ranges, per_beam=True)
    (launch,) = recorder.launches
    true_log_p, true_parts = replay(launch)
    assert (launch.values["log_p"] == log_p).all()
    np.testing.assert_array_equal(np.sort(launch.parts, axis=1)[:, :5], np.sort(parts, axis=1)[:, :5])
    assert beam_tolerance(precision).difference(launch.parts, true_parts) <= beam_tolerance(precision).value
    bound = per_scan(true_parts, precision, fixed=float(launch.values["score"].constant_term), temperature=temperature)
    same = log_p == true_log_p
    assert (np.abs(np.where(same, 0, log_p) - np.where(same, 0, true_log_p)) <= bound).all()


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_an_end_point_on_an_edge_may_go_to_either_cell_but_no_other_one(precision):
    """Poses are on corners, and the resolution is not exact: rounding decides which side of the edge beams end on."""
    cells = np.zeros((40, 40), np.int8)
    cells[::7, ::5] = 100
    grid = gs.OccupancyGrid(cells, 0.1)
    row, col = np.divmod(np.arange(30 * 30), 30)
    corners = (grid.cell_centers(row + 1, col + 1) + grid.cell_centers(row, col)) / 2
    poses = np.column_stack([corners, np.zeros(900)])
    recorder = Recorder(get_backend("numpy"))
    model = gs.LikelihoodFieldModel(
        grid, gs.Scanner([0.0, math.pi / 2], 5.0), gs.LikelihoodFieldParameters(), backend=recorder, precision=precision
    )
    model.log_likelihood(poses, [0.3, 0.5], per_beam=True)
    (launch,) = recorder.launches
    assert differing(replay(launch)[1].astype(launch.parts.dtype), launch.parts) == 0
    elsewhere = launch.parts.copy()
    elsewhere[5] -= 1
    assert np.count_nonzero(replay(launch, elsewhere)[1].astype(launch.parts.dtype) != elsewhere) == 2


def test_replay_casts_on_the_device_that_scored(scene):
    for selection in ("numpy", *others()):
        recorder = Recorder(get_backend(selection))
        model = gs.BeamModel(scene.grid, scene.scanner, backend=recorder)
        model.log_likelihood(scene.poses[:50], scene.ranges, per_beam=True)
        columns = np.flatnonzero(gs.classify(scene.ranges, scene.scanner) == gs.Reading.HIT)
        expected = gs.BeamModel(scene.grid, scene.scanner, backend=selection).expected_ranges(scene.poses[:50])
        assert differing(recorder.launches[0].expected, expected[:, columns]) == 0


# ---- the command


# The command's scenes cause no warning.
@pytest.mark.filterwarnings("error::gpusense.world.plausible.PlausibilityWarning")
@pytest.mark.long
def test_json_lists_every_comparison(capsys):
    code, out, err = run(capsys, "--json", "--backend", "numpy")
    assert err == ""
    document = json.loads(out)
    assert code == 0
    assert document["passed"] is True
    assert [backend["selection"] for backend in document["backends"]] == ["numpy"]
    quantities = {check["quantity"] for check in document["checks"]}
    assert {"distance transform", "float32 beam model, scans", "field, nearest, look-ups"} <= quantities
    assert "float64 sonar by incidence, beams" in quantities
    assert all(check["tolerance"]["reason"] for check in document["checks"])


def named(kernel, arguments):
    """Return the arguments of a kernel's reference by name."""
    return dict(zip([argument.name for argument in KERNELS[kernel].arguments], arguments[1:], strict=True))


def shift_ranges(*arguments):
    reference_cast_ranges(*arguments)
    found = named("cast_ranges", arguments)["ranges"]
    found[17] = np.nextafter(found[17], found.dtype.type(100))


def add_to_squares(*arguments):
    envelope(*arguments)
    arguments[3][5] += 1


def add_to_scan(*arguments):
    score_beams(*arguments)
    named("score_beams", arguments)["log_p"][3] += 0.01


def add_to_beam(*arguments):
    score_beams(*arguments)
    if "PER_BEAM" in arguments[0]:
        named("score_beams", arguments)["parts"][7] += np.float32(1e-4)


def densities_of_another_mixture(flags, z, expected, terms):
    found = log_density(flags, z, expected, terms)
    return np.where(z < 1, found + 1e-3, found).astype(found.dtype) if found.dtype == np.float32 else found


def add_without_parts(*arguments):
    score_beams(*arguments)
    if "PER_BEAM" not in arguments[0]:
        log_p = named("score_beams", arguments)["log_p"]
        log_p[:] = np.nextafter(log_p, np.inf)


def parameters_of_another_angle(terms, edges, kinds, cosine):
    return incidence_terms(terms, edges, kinds, np.where(cosine < 0.6, 1, cosine))


def turn_an_angle(*arguments):
    cast_echoes(*arguments)
    if "INCIDENCE" in arguments[0]:
        named("cast_echoes", arguments)["incidence"][21] += 1e-3


incidence_terms, cast_echoes = echo.incidence_terms, echo.cast_echoes
reference_cast_ranges, envelope = ranges.cast_ranges, distance.distance_envelope
score_beams, log_density = beam.score_beams, mixture.log_density


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize(
    "module, name, broken, quantity",
    [
        (distance, "distance_envelope", add_to_squares, "distance transform"),
        (beam, "score_beams", add_to_scan, "float32 beam model, scans"),
        (beam, "score_beams", add_to_beam, "float32 beam model, beams"),
        (beam, "log_density", densities_of_another_mixture, "float32 beam model, beams"),
        (beam, "score_beams", add_without_parts, "float32 beam model, scans alone"),
        (ranges, "cast_ranges", shift_ranges, "float32 ranges"),
        (beam, "incidence_terms", parameters_of_another_angle, "float64 sonar by incidence, beams"),
        (echo, "cast_echoes", turn_an_angle, "float32 angles of incidence"),
    ],
)
def test_a_breach_is_detected(capsys, monkeypatch, module, name, broken, quantity):
    monkeypatch.setattr(module, name, broken)
    whole = selftest.built_in_scene()
    monkeypatch.setattr(selftest, "built_in_scene", lambda: dataclasses.replace(whole, poses=whole.poses[::9]))
    partner = others()[0] if name in ("cast_ranges", "cast_echoes") else "numpy"
    kept, compare = [], selftest.run

    def compare_once(*arguments, checks, **options):
        if not kept:
            compare(*arguments, checks=kept, **options)
        checks += kept

    monkeypatch.setattr(selftest, "run", compare_once)
    code, out, _ = run(capsys, "--backend", "numpy", "--backend", partner, "--json")
    document = json.loads(out)
    assert code == 1
    assert document["passed"] is False
    assert quantity in {check["quantity"] for check in document["checks"] if not check["passed"]}
    if name == "cast_ranges":
        code, out, _ = run(capsys, "--backend", "numpy", "--backend", partner)
        assert code == 1
        assert "BREACH" in out


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("kernel", [None, "sum_parts", "order_fill"])
def test_a_breach_of_a_gpu_is_detected(kernel, monkeypatch):
    """Only GPUs use tiles, orders and sums; the reference passes as a GPU."""
    backend = NumpyBackend()
    backend.info = dataclasses.replace(backend.info, kind="gpu")
    monkeypatch.setattr(selftest, "_REPEATS", 2)
    monkeypatch.setattr(tiles, "LEAST_ORDERED", (1, 1))
    module = {"sum_parts": sums, "order_fill": order, None: None}[kernel]
    if module is not None:
        right = getattr(module, kernel)

        def wrong(flags, *arguments):
            right(flags, *arguments)
            written = arguments[2] if kernel == "order_fill" else arguments[4]
            written[0] = written[1] if kernel == "order_fill" else written[0] + 1

        monkeypatch.setattr(module, kernel, wrong)
    whole = selftest.built_in_scene()
    scene = dataclasses.replace(whole, poses=whole.poses[::9])
    _, checks = selftest.evaluate_backend(backend, scene)
    failed = {check.quantity for check in checks if not check.passed}
    assert ("float32 beam model, scans alone" in failed) == (kernel is not None)
    assert failed <= {check.quantity for check in checks if check.quantity.endswith("alone")}


def test_an_absent_backend_is_an_error_only_when_named(capsys):
    code, out, err = run(capsys, "--backend", "warp:cuda:99")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert run(capsys, "--backend", "vulkan")[0] == 2


def test_a_single_backend_is_held_against_numpy():
    name = others()[0]
    assert [b.info.selection for b in selftest.chosen_backends([name])] == ["numpy", name]
    assert [b.info.selection for b in selftest.chosen_backends(["numpy"])] == ["numpy"]
    assert not any("simulator" in b.info.name.lower() for b in selftest.chosen_backends())


def test_a_stiff_breach_is_reported_and_fails(capsys, monkeypatch):
    wrong = Check("numpy", "truth", "log p; a case", 17.0, beam_tolerance("float32"))
    monkeypatch.setattr(stiff, "run", lambda backend, precision: [wrong])
    assert main(["selftest", "--stiff", "--backend", "numpy"]) == 1
    output = capsys.readouterr().out
    assert "BREACH" in output
    assert output.startswith("FAILED: 2 of 2 comparisons beyond tolerance")
