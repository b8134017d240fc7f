"""Type checkers find wrong names of choices, and accept arrays and lists of any kind."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from support.paths import ROOT

from gpusense._util import typing as types
from gpusense.interface.casters import ENTRIES
from gpusense.learning.beam.device_sums import METHODS
from gpusense.peers.weights import PEERS
from gpusense.positions.problem import LOSSES

HEAD = """\
import numpy as np
import gpusense as gs

grid = gs.OccupancyGrid(np.zeros((4, 4), int), 0.1)
scanner = gs.Scanner([0.0], range_max=4.0)
poses = [(0.2, 0.2, 0.0)]
"""
GOOD = """\
model = gs.BeamModel(grid, scanner, precision="float64", unknown="occupied", caster="dda", backend="numpy")
log_p: np.ndarray = model.log_likelihood(poses, [1.0])
more: np.ndarray = model.log_likelihood(np.zeros((5, 3)), np.ones(1, np.float32))
again = gs.LikelihoodFieldModel(grid, scanner, precision=model.precision, compat=None)
model.update_map([[100]], (0, 0))
gs.RayCaster(grid, 4.0, method="lookup").cast(poses, [0.0])
gs.LandmarkModel(gs.LandmarkMap([(0.0, 1.0)]), association="joint").log_likelihood(poses, [(1.0, 0.1)])
gs.fit_beam_parameters([1.0], [1.0], 4.0, method="gradient")


class Tensor:
    def __dlpack__(self, *, stream: object = None) -> object:
        return self

    def __dlpack_device__(self) -> tuple[int, int]:
        return 1, 0


model.log_likelihood(Tensor(), Tensor())
"""
BAD = (
    'gs.BeamModel(grid, scanner, precision="flaot32")',
    'gs.BeamModel(grid, scanner, compat="nav2")',
    'gs.BeamModel(grid, scanner, caster="fast")',
    'gs.LikelihoodFieldModel(grid, scanner, outside="Free")',
    'gs.RayCaster(grid, 4.0, precision="float16")',
    "gs.RayCaster(grid, 4.0).cast(None, [0.0])",
    'gs.LandmarkModel(gs.LandmarkMap([(0.0, 1.0)]), association="neares")',
    'gs.PositionModel(precision="double")',
    'gs.fit_beam_parameters([1.0], [1.0], 4.0, method="EM")',
    'gs.trilaterate([(0.0, 0.0)], [1.0], loss="l1")',
    'gs.surface_normals(grid, unknown="wall")',
    'gs.LikelihoodFieldParameters(interpolation="cubic")',
    "gs.BeamModel(grid, scanner).log_likelihood(scanner, [1.0])",
)


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str]]:
    """Check a file and the package with mypy, and return the file's lines of errors and their texts.

    The type checker of CI then finds the package checked.
    """
    folder = tmp_path_factory.mktemp("types")
    file = folder / "user.py"
    file.write_text(HEAD + GOOD + "\n".join(BAD) + "\n", encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), "--no-error-summary",
               "--cache-dir", os.environ.get("MYPY_CACHE_DIR", str(folder / "cache")),
               "gpusense", str(file)]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    found = re.findall(r"^(.*?):(\d+): error: (.*)$", done.stdout, re.M)
    assert {Path(name).name for name, _, _ in found} <= {"user.py"}, done.stdout
    return [(int(line), text) for _, line, text in found]


@pytest.mark.long
def test_right_calls_pass(errors):
    assert [each for each in errors if each[0] <= (HEAD + GOOD).count("\n")] == []


@pytest.mark.long
@pytest.mark.parametrize("call", BAD)
def test_a_mistake_is_seen(errors, call):
    line = (HEAD + GOOD).count("\n") + 1 + BAD.index(call)
    reasons = ("incompatible type", "No overload variant")
    assert [text for at, text in errors if at == line and any(reason in text for reason in reasons)], call


def test_names_of_types_are_those_of_registries():
    assert get_args(types.CasterName) == tuple(ENTRIES)
    assert get_args(types.Compat) == tuple(PEERS)
    assert get_args(types.FitMethod) == METHODS
    assert get_args(types.Loss) == tuple(LOSSES)
