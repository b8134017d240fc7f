"""``repr`` of models and casters names kind, map, beams, caster, precision and device in one line."""

import numpy as np
import pytest

import gpusense as gs

GRID = gs.OccupancyGrid(np.zeros((30, 40), int), resolution=0.1)
SCANNER = gs.Scanner(np.linspace(-1, 1, 9), range_max=5.0)
END = "precision='float32', backend='numpy')"
MAP = "30 x 40 cells, resolution=0.1"

CASES = [
    (gs.BeamModel(GRID, SCANNER, backend="numpy"), f"BeamModel({MAP}, beams=9, caster=Exact(), {END}"),
    (
        gs.BeamModel(GRID, SCANNER, beams=5, caster=gs.casters.March(tolerance=0.02), backend="numpy"),
        f"BeamModel({MAP}, beams=5 of 9, caster=March(tolerance=0.02, rule='safe'), {END}",
    ),
    (
        gs.LikelihoodFieldModel(GRID, SCANNER, beams=[1, 4], precision="float64", backend="numpy"),
        f"LikelihoodFieldModel({MAP}, beams=2 of 9, precision='float64', backend='numpy')",
    ),
    (
        gs.LikelihoodFieldModel(GRID, SCANNER, compat="amcl", backend="numpy"),
        f"LikelihoodFieldModel({MAP}, beams=9, compat='amcl', {END}",
    ),
    (gs.RayCaster(GRID, 5.0, backend="numpy"), f"RayCaster({MAP}, range_max=5.0, caster=Exact(), {END}"),
    (
        gs.LandmarkModel(gs.LandmarkMap([(0, 0), (1, 1)]), association="sum", backend="numpy"),
        f"LandmarkModel(landmarks=2, association='sum', {END}",
    ),
    (gs.LineModel(gs.LineMap([(0, 0, 1, 1)]), backend="numpy"), f"LineModel(lines=1, association='nearest', {END}"),
    (gs.PositionModel(gs.PositionParameters(sigma=2.0), backend="numpy"), f"PositionModel({END}"),
    (gs.HeadingModel(backend="numpy"), f"HeadingModel(kind='wrapped_normal', {END}"),
    (gs.BeaconModel([(0, 0), (1, 1), (2, 0)], backend="numpy"), f"BeaconModel(beacons=3, kind='normal', {END}"),
    (gs.BumperModel(GRID, 0.3, backend="numpy"), f"BumperModel({MAP}, segments=1, {END}"),
]


@pytest.mark.parametrize(("model", "text"), CASES, ids=[text[: text.index("(")] for _, text in CASES])
def test_repr(model, text):
    assert repr(model) == text


def test_repr_makes_no_table():
    model = gs.BeamModel(GRID, SCANNER, backend="numpy")
    assert repr(model) and model.table_bytes == 0


def test_repr_follows_the_device(device):
    assert repr(gs.RayCaster(GRID, 5.0, backend=device)).endswith(f"backend={device.info.selection!r})")
