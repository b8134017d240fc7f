"""``gpusense fit``: parameters of a simulated log, of a real one, of pairs; files, hold-out, bad input."""

from __future__ import annotations

import gzip
import json
import math

import numpy as np
import pytest
import yaml
from scipy.integrate import quad
from support.room_log import write_building

import gpusense as gs
from gpusense.commands.cli import main
from gpusense.evaluation import range_data as fitting
from gpusense.models.scan.densities import log_mixture

TRUTH = gs.BeamParameters(z_hit=0.8, z_short=0.08, z_max=0.05, z_rand=0.07, sigma_hit=0.04, lambda_short=0.5)
SCANS, BEAMS, RANGE = 60, 60, 10.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Write a building's map, a log of 60 scans in it, and the same readings as pairs."""
    folder = tmp_path_factory.mktemp("recorded")
    grid, scanner, poses, ranges = write_building(folder, SCANS, BEAMS, TRUTH)
    model = gs.BeamModel(grid, scanner, backend="numpy", precision="float64")
    readings = zip(np.concatenate(ranges), model.expected_ranges(poses).ravel(), strict=True)
    pairs = ["z,expected", *(f"{z:.4f}, {float(e)!r}" for z, e in readings)]
    (folder / "pairs.csv").write_text("\n".join(pairs) + "\n")
    with gzip.open(folder / "pairs.csv.gz", "wt") as stream:
        stream.write("\n".join(pairs) + "\n")
    return folder


def run(capsys, *arguments):
    code = main(["fit", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def of_log(folder):
    return ["--map", folder / "map.yaml", "--log", folder / "run.log"]


def test_the_parameters_of_a_simulated_log_are_found(capsys, recorded, tmp_path):
    """All 6 parameters are within 4 standard errors, except in one of 2600 such logs."""
    out = tmp_path / "made" / "here"
    code, text, err = run(capsys, *of_log(recorded), "--json", "--out", out, "--incidence", 3)
    assert (code, err) == (0, "")
    document = json.loads(text)
    fit = document["fit"]
    assert document["readings"] == SCANS * BEAMS == fit["hits"] + fit["max_readings"] and document["blocks"] == SCANS
    for name, value in TRUTH.to_dict().items():
        assert abs(fit["parameters"][name] - value) < 4 * fit["standard_errors"][name], name
    written = yaml.safe_load((out / "parameters.yaml").read_text())
    assert written["beam_model"] == fit["parameters"]
    assert gs.BeamParameters.from_dict(written["beam_model"]) == gs.BeamParameters.from_dict(fit["parameters"])
    assert len(gs.IncidenceParameters.from_dict(written["incidence_model"]).parameters) == 3
    nav2 = written["amcl"]["ros__parameters"]
    assert nav2 == {"laser_model_type": "beam", **fit["parameters"], "laser_max_range": RANGE}
    names = {"parameters.yaml", "readings.png", "density.png", "trace.png", "surface.png", "incidence.png"}
    assert {path.name for path in out.iterdir()} == names and len(document["files"]) == len(names)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in out.glob("*.png"))


def test_pairs_are_fitted_as_the_log_they_come_from(capsys, recorded):
    chosen = ["--every", 2, "--offset", 1, "--json"]
    _, of_scans, _ = run(capsys, *of_log(recorded), *chosen)
    scans = json.loads(of_scans)["fit"]["parameters"]
    for name in ("pairs.csv", "pairs.csv.gz"):
        code, text, _ = run(capsys, "--pairs", recorded / name, "--range-max", RANGE, "--json")
        assert code == 0 and json.loads(text)["fit"]["hits"] + json.loads(text)["fit"]["max_readings"] == SCANS * BEAMS
    # Every other pair differs from every other scan, with equally many readings.
    _, text, _ = run(capsys, "--pairs", recorded / "pairs.csv", "--range-max", RANGE, *chosen)
    pairs = json.loads(text)
    assert pairs["readings"] == SCANS * BEAMS // 2
    for name, value in pairs["fit"]["parameters"].items():
        assert abs(value - scans[name]) < 6 * pairs["fit"]["standard_errors"][name], name


def test_held_out_scans_are_likelier_by_the_fit_than_by_defaults(capsys, recorded):
    code, text, _ = run(capsys, *of_log(recorded), "--holdout", "--json")
    document = json.loads(text)
    fitted, *others = document["held_out"]
    assert code == 0 and document["readings"] == document["held_out_readings"] == SCANS * BEAMS // 2
    assert fitted["name"] == "fitted" and fitted["gain"] == 0 and [o["name"] for o in others] == [
        "nav2_amcl's defaults", "Beluga's defaults",
    ]  # fmt: skip
    for other in others:
        assert other["gain"] > 10 * other["gain_error"] > 0
        assert fitted["per_beam"] - other["per_beam"] == pytest.approx(other["gain"])
        weights = [other["parameters"][f"z_{name}"] for name in ("hit", "short", "max", "rand")]
        assert sum(weights) == pytest.approx(1)
    code, text, _ = run(capsys, *of_log(recorded), "--holdout")
    assert code == 0 and "held out: 1800 readings" in text and "Beluga's defaults" in text and "z_hit" in text


@pytest.mark.long
def test_the_fit_by_incidence_is_scored_on_held_out_pairs(capsys, tmp_path):
    """The deviation rises with the angle: the mixtures of the bins and the mixture for all angles are scored."""
    random = np.random.default_rng(1)
    angle, expected = random.uniform(0, 1.5, 4000), random.uniform(2, 8, 4000)
    angle[::50] = math.nan
    z = expected + random.normal(0, np.where(angle > 0.75, 0.3, 0.03))
    rows = [",".join(map(repr, row)) for row in np.stack([z, expected, angle], 1).tolist()]
    (tmp_path / "angles.csv").write_text("\n".join(rows))
    arguments = ["--pairs", tmp_path / "angles.csv", "--range-max", RANGE, "--incidence", 2, "--holdout"]
    code, text, _ = run(capsys, *arguments, "--json")
    document = json.loads(text)
    fitted, own, *others = document["held_out"]
    assert code == 0 and own["name"] == "fitted by incidence" and len(others) == 2
    assert own["gain"] < -0.3 < -10 * own["gain_error"]
    assert fitted["per_beam"] - own["per_beam"] == pytest.approx(own["gain"])
    # By hand: the densities of each bin's parameters at the readings of blocks 1, 3, 5, ....
    odd = np.arange(4000) // 100 % 2 == 1
    parameters = gs.IncidenceParameters.from_dict(document["incidence"]["parameters"])
    total = 0.0
    for chosen, each in (
        (angle < math.pi / 4, parameters.parameters[0]), (angle >= math.pi / 4, parameters.parameters[1]),
        (np.isnan(angle), parameters.no_surface),
    ):  # fmt: skip
        total += log_mixture(z[odd & chosen], expected[odd & chosen], range_max=RANGE, **each.to_dict()).sum()
    assert own["per_beam"] == pytest.approx(total / 2000, rel=1e-9)
    assert document["fit"]["blocks"] == 20 and document["incidence"]["pooled"]["blocks"] == 20
    _, text, _ = run(capsys, *arguments)
    assert text.startswith("FITTED: ") and "fitted by incidence" in text and "if independent" not in text
    assert "if independent" in run(capsys, *arguments, "-v")[1]


def test_a_bias_is_fitted_and_taken_off_held_out_readings(capsys, recorded, tmp_path):
    rows = [line.split(",") for line in (recorded / "pairs.csv").read_text().splitlines()[1:]]
    moved = [f"{float(z) + (0.3 if float(z) < 9 else 0)},{float(e)}" for z, e in rows if float(e) < 9]
    (tmp_path / "moved.csv").write_text("\n".join(moved))
    arguments = ["--pairs", tmp_path / "moved.csv", "--range-max", RANGE, "--range-bias", "--holdout", "--json"]
    _, text, _ = run(capsys, *arguments)
    document = json.loads(text)
    fit = document["fit"]
    assert abs(fit["range_bias"] - 0.3) < 4 * fit["range_bias_error"] + 0.005
    # The means of the held-out and the fitted half agree within the error by blocks.
    fitted = document["held_out"][0]
    assert abs(fitted["per_beam"] - fit["log_likelihood"] / document["readings"]) < 5 * fitted["error"]


def test_log_likelihoods_are_those_of_the_model(recorded):
    grid, scans = gs.read_map(recorded / "map.yaml"), list(gs.read_log(recorded / "run.log"))
    numbered = list(enumerate(scans))
    data = fitting.data_of_log(grid, numbered, backend="numpy", block=7)
    model = gs.BeamModel(grid, scans[0].scanner, TRUTH, backend="numpy", precision="float64")
    wanted = [model.log_likelihood([scan.pose], scan.ranges)[0] for scan in scans]
    found = fitting.log_densities(TRUTH, data).reshape(SCANS, BEAMS).sum(axis=1)
    # One casts in float32, the other in float64.
    np.testing.assert_allclose(found, wanted, atol=0.05)
    assert data.block.tolist() == [i // 7 for i in range(SCANS) for _ in range(BEAMS)]
    even, odd = data.halves()
    assert len(even.ranges) == 7 * BEAMS * 4 + 4 * BEAMS and len(even.ranges) + len(odd.ranges) == SCANS * BEAMS


def test_peers_are_proper_densities():
    """Weights divided by their sum, so that range readings and no return have mass 1."""

    def density(z, p):
        data = fitting.RangeData(np.array([z]), np.array([3.0]), None, np.zeros(1, int), RANGE)
        return math.exp(fitting.log_densities(p, data)[0])

    for p in fitting.peer_parameters().values():
        mass = quad(density, 0, RANGE, args=(p,), points=[2, 3, 4], limit=200)[0]
        assert mass + p.z_max == pytest.approx(1, abs=1e-6)


def test_standard_errors_are_those_of_blocks():
    """40 blocks of 25 equal values have the information of 40 values; unequal blocks use a ratio of sums."""
    random = np.random.default_rng(0)
    values = random.normal(size=40)
    mean, error = fitting.block_mean(np.repeat(values, 25), np.repeat(np.arange(40), 25))
    assert mean == pytest.approx(values.mean()) and error == pytest.approx(values.std(ddof=1) / math.sqrt(40))
    mean, error = fitting.block_mean(np.array([1.0, 3.0, 3.0, 3.0]), np.array([0, 1, 1, 1]))
    assert mean == 2.5 and error == pytest.approx(math.sqrt(2 * (1.5**2 + 1.5**2)) / 4)
    assert math.isnan(fitting.block_mean(np.ones(3), np.zeros(3, int))[1])
    mean, error = fitting.block_mean(np.array([1.0, -math.inf]), np.array([0, 1]))
    assert mean == -math.inf and math.isnan(error)


def test_impossible_readings_are_counted(capsys, tmp_path):
    """The fitted half has no reading of no return: z_max is 0, and such readings of the other half are impossible."""
    rows = [f"{1 + 0.01 * (i % 7)},1" if i < 100 or i % 10 else "inf,1" for i in range(200)]
    (tmp_path / "some.csv").write_text("\n".join(rows))
    _, text, _ = run(capsys, "--pairs", tmp_path / "some.csv", "--range-max", 4, "--holdout", "--json")
    fitted, soft, amcl, _ = json.loads(text)["held_out"]
    assert fitted["impossible"] == 10 and fitted["per_beam"] is None and fitted["gain"] is None
    # Half a reading of no return added to 100 ranges.
    assert soft["name"] == "fitted, softened" and soft["gain"] == 0 and soft["parameters"]["z_max"] == 0.5 / 102
    assert amcl["gain"] == pytest.approx(soft["per_beam"] - amcl["per_beam"])
    _, text, _ = run(capsys, "--pairs", tmp_path / "some.csv", "--range-max", 4, "--holdout")
    assert "fitted: 10 held-out readings are impossible" in text


def test_pairs_are_read_in_blocks(tmp_path, monkeypatch):
    rows = np.random.default_rng(0).uniform(0, 5, (100, 3))
    text = "# a comment\nrange;or so\n\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    (tmp_path / "three.csv").write_text("\ufeff" + text)
    monkeypatch.setattr(fitting, "_LINES", 7)
    for choice in ({}, {"every": 3, "offset": 5}, {"every": 9, "offset": 20, "limit": 4}, {"limit": 1}):
        data = fitting.data_of_pairs(tmp_path / "three.csv", 6.0, **choice)
        wanted = rows[choice.get("offset", 0) :: choice.get("every", 1)][: choice.get("limit")]
        np.testing.assert_array_equal(np.stack([data.ranges, data.expected, data.incidence], 1), wanted)


def test_real_logs_have_real_parameters(capsys, data_dir):
    """The Intel log, of a SICK LMS, in a map of its even scans with cells of 5 cm."""
    folder = data_dir / "carmen_logs"
    code, text, _ = run(
        capsys, "--map", folder / "derived_maps" / "intel_even_05cm.yaml", "--log", folder / "intel-corrected.log.gz",
        "--every", 18, "--offset", 1, "--holdout", "--json",
    )  # fmt: skip
    document = json.loads(text)
    p = document["fit"]["parameters"]
    assert code == 0 and document["range_max"] == 81.83
    assert 0.8 < p["z_hit"] < 0.97 and 0.03 < p["sigma_hit"] < 0.15 and 0.01 < p["z_max"] < 0.05
    for other in document["held_out"][1:]:
        assert other["gain"] > 5 * other["gain_error"]


LOG = ["--map", "{map}", "--log", "{log}"]
PAIRS = ["--pairs", "{file}", "--range-max", "5"]


@pytest.mark.parametrize(("contents", "arguments", "message"), [
    (None, [], "--map: must be given unless --pairs is, got none"),
    (None, LOG[:2], "--log: must be given unless --pairs is, got none"),
    ("1,1", [*LOG, *PAIRS], "--map: must be left out with --pairs, got {map}"),
    ("1,1", PAIRS[:2], "--range-max: must be given with --pairs, got none"),
    ("1,1", [*PAIRS, "--range-min", "5"], "--range-min: must be < --range-max = 5.0, got 5.0"),
    (None, [*LOG, "--range-min", "50"], "--range-min: must be < range_max = 10.0, got 50.0"),
    (None, [*LOG, "--limit", "1", "--holdout"], "holdout: must have at least 2 blocks of readings, got 1"),
    (None, [*LOG, "--out", "{map}"],
     "argument --out: must be a folder that can be written to, got '{map}': "),
    (None, [*LOG, "--method", "em-book", "--range-bias"], "range_bias: must be False with method 'em-book'"),
    ("1,1", [*PAIRS, "--incidence", "3"],
     "--incidence: must have pairs with a third column, the angle, got two in {file}"),
    ("", PAIRS, "pairs: must hold a pair of index 0, the first one chosen, got fewer pairs in {file}"),
    ("1,1\n2,2\n", [*PAIRS, "--offset", "2"],
     "pairs: must hold a pair of index 2, the first one chosen, got fewer pairs"),
    ("z,e\n1,1\nx,2\n", PAIRS, "{file}: line 3: must hold numbers, got 'x'"),
    ("1,1\n\n1,2,3\n", PAIRS, "{file}: line 3: must hold 2 numbers with commas between them, got 3"),
    ("1,2,3,4\n", PAIRS, "{file}: line 1: must hold 2 or 3 numbers with commas between them, got 4"),
    ("1,2\n" + "1," * 3000, PAIRS, "{file}: line 2: must have at most 4096 bytes, got more"),
    ("nan,1\nnan,1\n", PAIRS, "ranges: must hold a reading that is not missing, got 2 of which none is"),
    ("z,e\n1,1\n1,9\n", PAIRS,
     "{file}: pair 1: the expected range must be in [0, 5.0] where the reading is not missing, got 9.0"),
    ("1,1\n" * 8 + "1,nan\n", [*PAIRS, "--offset", "2", "--every", "2", "--holdout", "--block", "1"],
     "{file}: pair 8: the expected range must be in [0, 5.0] where the reading is not missing, got nan"),
    (b"\x1f\x8b\x08junk", PAIRS, "{file}:1: must be a whole gzip file, got "),
    (b"\xff\xfe\x00", PAIRS, "pairs: must hold a pair of index 0"),
])  # fmt: skip
def test_bad_input_is_one_line(capsys, recorded, tmp_path, contents, arguments, message):
    file = tmp_path / "pairs.csv"
    if contents is not None:
        file.write_bytes(contents if isinstance(contents, bytes) else contents.encode())
    names = {"map": recorded / "map.yaml", "log": recorded / "run.log", "file": file, "folder": tmp_path}
    backend = [] if "--backend" in arguments else ["--backend", "numpy"]
    code = main(["fit", *(text.format(**names) for text in arguments), *backend])
    captured = capsys.readouterr()
    assert (code, captured.out) == (2, "") and captured.err.count("\n") == 1
    assert message.format(**names) in captured.err


@pytest.mark.parametrize(
    "share, bias, verdict", [(0.02, 0.0, "FITTED"), (0.17, 0.05, "FITTED"), (0.6, 0.0, "DOUBTFUL")]
)
def test_unexplained_readings_and_an_offset_are_judged(capsys, tmp_path, share, bias, verdict):
    """Few unexplained readings need no word, many name where to look, most make the fit doubtful."""
    random = np.random.default_rng(1)
    expected = random.uniform(2.0, 7.0, 2000)
    z = expected + bias + random.normal(0.0, 0.02, 2000)
    wild = random.random(2000) < share
    z[wild] = random.uniform(0.0, RANGE, wild.sum())
    (tmp_path / "pairs.csv").write_text("\n".join(f"{a!r},{b!r}" for a, b in np.stack([z, expected], 1).tolist()))
    text = run(capsys, "--pairs", tmp_path / "pairs.csv", "--range-max", RANGE)[1]
    assert text.startswith(f"{verdict}: ")
    assert ("\nmany " in text) == (0.11 < share < 0.25) and ("\ndoubt " in text) == (share > 0.25)
    assert ("ranges are 5 cm too long" in text and "--range-bias" in text) == (bias > 0)
