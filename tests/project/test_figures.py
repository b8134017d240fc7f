"""Interactive figures as the site's build writes them: their script computes gpusense's numbers."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.paths import ROOT

import gpusense as gs

DOCS = ROOT / "docs"
NAMES = ("beam", "scan", "em")
DATA = re.compile(r'(<script type="application/json" id="data">)(.*?)(</script>)', re.DOTALL)


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    """Return the module that writes the pages."""
    spec = importlib.util.spec_from_file_location("make_figures", DOCS / "make_figures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def written(figures: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the pages by their names."""
    folder = tmp_path_factory.mktemp("figures") / "made"
    figures.write_pages(folder)
    return {file.stem: file.read_text(encoding="utf-8") for file in folder.iterdir()}


def test_each_figure_has_a_page(written: dict[str, str]) -> None:
    assert set(written) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_pages_fetch_nothing(written: dict[str, str], name: str) -> None:
    text = written[name]
    assert not re.search(
        r"https?:|\bsrc=|\bhref=|\bimport\b|\bfetch\(|XMLHttp|@import|url\(|\{style\}|\{model\}|\{data\}", text
    )


def in_node(code: str, data: Any) -> Any:
    """Return the value of a JavaScript expression with the figures' functions and ``data``."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node is not installed; pages compare themselves with the numbers that are checked above")
    model = (DOCS / "figures" / "model.js").read_text(encoding="utf-8")
    source = f"{model}\nconst data = JSON.parse(require('fs').readFileSync(0)); console.log(JSON.stringify({code}));"
    done = subprocess.run([node, "-e", source], input=json.dumps(data), capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_the_script_has_the_densities_of_gpusense(figures: ModuleType) -> None:
    random = np.random.default_rng(3)
    z = np.linspace(0.0, 4.999, 60)
    rows, expected = [], []
    for _ in range(40):
        weights = random.dirichlet(np.full(4, 0.6)).tolist()
        values = dict(zip(("z_hit", "z_short", "z_max", "z_rand"), weights, strict=True))
        values |= {"sigma_hit": random.uniform(0.02, 1.0), "lambda_short": random.choice([0.0, random.uniform(0, 4)])}
        row = {"parameters": values, "expected": float(random.uniform(0.1, 4.9))}
        rows.append(row | {"z": z.tolist()})
        expected.append(figures.beam_density(gs.BeamParameters(**values), row["expected"], z))
    code = "data.map(one => one.z.map(z => densities(z, one.expected, 5, one.parameters).sum))"
    np.testing.assert_allclose(in_node(code, rows), expected, rtol=1e-10, atol=1e-280)


def models_of(data: Any) -> tuple[gs.BeamModel, gs.LikelihoodFieldModel, list[float]]:
    """Return both models and the readings from a page's data."""
    cells = np.array(list(data["map"]["cells"]), np.int8).reshape(data["map"]["rows"], -1) * 100
    grid = gs.OccupancyGrid(cells, resolution=data["map"]["resolution"])
    scanner = gs.Scanner(data["scan"]["bearings"], range_max=data["scan"]["range_max"])
    options = {"precision": "float64", "backend": "numpy"}
    field = gs.LikelihoodFieldParameters(**data["field"])
    return (
        gs.BeamModel(grid, scanner, gs.BeamParameters(**data["beam"]), **options),
        gs.LikelihoodFieldModel(grid, scanner, field, **options),
        [np.inf if z is None else z for z in data["scan"]["ranges"]],
    )


def test_the_script_has_the_likelihoods_of_gpusense(figures: ModuleType) -> None:
    data = figures.scan_data()
    beam, field, ranges = models_of(data)
    assert 0 < np.isinf(ranges).sum() < 20
    # Poses in walls, at the edge, and with beams along the axes.
    poses = np.random.default_rng(1).uniform([0, 0, -4], [14, 10, 4], (60, 3)).round(3)
    poses[:4] = [[5.05, 5.05, 0.0], [0.0, 0.0, np.pi / 2], [13.999, 9.999, -np.pi], [2.0, 1.5, 0.0]]
    code = """(() => { const map = unpacked(data.map), far = distances(map, data.field.max_distance);
        return data.at.map(pose => [...expectedRanges(map, pose, data.scan), logBeam(map, pose, data.scan, data.beam),
        logField(map, far, pose, data.scan, data.field)]); })()"""
    caster = gs.RayCaster(beam.grid, range_max=8.0, precision="float64", backend="numpy")
    found = np.array(in_node(code, data | {"at": poses.tolist()}))
    expected = [caster.cast(poses, beam.scanner.bearings)]
    expected += [model.log_likelihood(poses, ranges)[:, None] for model in (beam, field)]
    np.testing.assert_allclose(found, np.hstack(expected), rtol=1e-9, atol=1e-9)


def test_the_script_takes_the_steps_of_the_books_em() -> None:
    random, expected = np.random.default_rng(5), 2.0
    ranges = np.concatenate([random.normal(expected, 0.2, 150), random.uniform(0, 5, 40), np.full(10, 5.0)]).round(3)
    start = gs.BeamParameters(sigma_hit=0.6, lambda_short=0.4)
    known = {"range_max": 5.0, "expected": expected, "start": start.to_dict()}
    steps = []
    for count in (1, 3, 12):
        fit = gs.fit_beam_parameters(
            ranges, np.full(ranges.size, expected), 5.0, method="em-book", initial=start, max_iterations=count,
            tolerance=1e-300, backend="numpy", precision="float64",
        )  # fmt: skip
        assert fit.iterations == count
        steps.append({"count": count, "parameters": fit.parameters.to_dict(), "log_likelihood": float(fit.trace[-1])})
    data = known | {"ranges": [z if z < 5.0 else None for z in ranges.tolist()], "steps": steps}
    assert in_node("disagreement(data)", data) < 1e-10
    steps[2]["parameters"]["sigma_hit"] *= 1.001
    assert in_node("disagreement(data)", data) == pytest.approx(1e-3, rel=0.01)


def test_a_wrong_script_is_found(written: dict[str, str]) -> None:
    data = json.loads(DATA.search(written["beam"]).group(2))
    assert in_node("disagreement(data)", data) < 1e-12
    data["densities"][1]["p"][3] *= 1.001
    assert in_node("disagreement(data)", data) == pytest.approx(1e-3, rel=0.01)
