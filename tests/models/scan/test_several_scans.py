"""Several scans in one call share launches, and have the bits of single calls."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from support.selection import on_every_backend

import gpusense as gs
from gpusense.backends import get_backend, processor
from gpusense.backends.proxy import Proxy
from gpusense.backends.workspace import Workspace
from gpusense.evaluation.tolerances import differing
from gpusense.models import chunking
from gpusense.models.scan import pipeline

BEAMS, RANGE = 37, 5.0
RNG = np.random.default_rng(5)
GRID = gs.OccupancyGrid(np.where(RNG.random((60, 70)) < 0.04, 100, 0).astype(np.int8), 0.1, (-0.5, 0.3, 0.2))
BEARINGS = np.linspace(-3, 3, BEAMS)
MOUNT = (0.1, -0.05, 0.2)
SCANNER = gs.Scanner(BEARINGS, RANGE, 0.1, mount=MOUNT)
REPEATED = gs.Scanner(np.repeat(BEARINGS[:13], 3)[:BEAMS], RANGE, 0.1, mount=MOUNT)
SONAR = gs.Scanner(BEARINGS[::6], RANGE, cone=0.3, cone_rays=4, mount=MOUNT)
STEEP = gs.IncidenceParameters((0.0, 0.6, np.pi / 2), (gs.BeamParameters(), gs.BeamParameters(0.5, 0.1, 0.3, 0.1)))
ATOMS = gs.LikelihoodFieldParameters(1.0, 0.0, 0.0)


def scans_of(scanner: gs.Scanner = SCANNER) -> np.ndarray:
    """Return scans with all distinct numbers of readings for blocks of 16; some are max or missing."""
    z = np.random.default_rng(8).uniform(0.1, 4.99, (11, scanner.count))
    z[1, 16:] = np.nan
    z[2, 17:] = -1.0
    z[3] = np.nan
    z[4] = np.inf
    z[5, ::3], z[5, 1::7] = np.inf, np.nan
    z[6, 1:] = np.nan
    z[7, :15] = [np.nan, RANGE, 0.05] * 5 if scanner.count >= 15 else np.nan
    z[8, 32:] = RANGE + 1
    z[9] = 4.99
    z[10, : scanner.count // 2] = np.nan
    return z


def clouds(scans: int, count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-1, -1, -4), (7, 7, 4), (scans, count, 3))


def beam(scanner: gs.Scanner = SCANNER, **options: Any) -> Any:
    return functools.partial(gs.BeamModel, GRID, scanner, **{"temperature": 0.7} | options)


def field(scanner: gs.Scanner = SCANNER, **options: Any) -> Any:
    return functools.partial(gs.LikelihoodFieldModel, GRID, scanner, **{"temperature": 0.7} | options)


# Arguments of models, and whether they run on Warp, where each set of flags compiles for seconds.
MODELS: dict[str, tuple[Any, bool]] = {
    "beam": (beam(), True),
    "beam, float64": (beam(precision="float64"), True),
    "beam, 11 beams": (beam(beams=11), False),
    "beam, beams of indices": (beam(beams=[0, 5, 20, 36]), False),
    "beam, repeated bearings": (beam(REPEATED), True),
    "beam, nothing left out": (beam(REPEATED, specialize=False), False),
    "beam, nothing left out or repeated": (beam(specialize=False), False),
    "beam, in the log domain": (beam(parameters=gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 1e-3)), False),
    "beam, cones": (beam(SONAR), False),
    "beam, angles of incidence": (beam(incidence=STEEP), False),
    "beam, amcl": (beam(compat="amcl"), False),
    "beam, beluga": (beam(compat="beluga"), False),
    "beam, table": (beam(sensor_table=0.1, caster="dda"), False),
    "field": (field(), True),
    "field, float64": (field(precision="float64"), True),
    "field, 11 beams": (field(beams=11), False),
    "field, smooth": (field(parameters=gs.LikelihoodFieldParameters(interpolation="bilinear")), False),
    "field, repeated bearings": (field(REPEATED), False),
    "field, nothing left out": (field(REPEATED, specialize=False), False),
    "field, impossible places": (field(parameters=ATOMS), False),
    "field, amcl": (field(compat="amcl"), False),
    "field, beluga": (field(compat="beluga"), False),
}


class Counting(Proxy):
    """A backend that counts launches by kernel."""

    def __init__(self, backend: Any) -> None:
        super().__init__(backend)
        self.launches = dict[str, int]()

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        def launch(*arguments: Any) -> None:
            self.launches[kernel] = self.launches.get(kernel, 0) + 1
            launcher(*arguments)

        launcher = self._backend.compile(kernel, flags)
        return launch


def assert_as_one_by_one(model: Any, poses: np.ndarray, z: np.ndarray) -> None:
    """Check that one call of all scans has the bits of calls of each, with and without ``out=``."""
    found = model.log_likelihood(poses, z)
    assert model._last.together > 1, "nothing was scored together"
    each = np.stack([model.log_likelihood(own, scan) for own, scan in zip(poses, z, strict=True)])
    assert found.dtype == each.dtype and differing(found, each) == 0
    out = np.full_like(found, 7)
    assert model.log_likelihood(poses, z, out=out) is out and differing(out, each) == 0


# Warp's kernels have the other models' flags in the same places.
@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.05)
@on_every_backend(name=MODELS, gpu=(False, True), on_warp=lambda name, gpu: MODELS[name][1])
def test_bits_are_those_of_single_calls(name, gpu, as_gpu, monkeypatch):
    device = as_gpu(gpu)
    # Particles in an order as well, as GPUs sort large clouds.
    monkeypatch.setattr("gpusense.models.scan.tiles.LEAST_ORDERED", (1, 1))
    model = MODELS[name][0](backend=device)
    z = scans_of(model.scanner)
    for count in (1, 65, 130):
        assert_as_one_by_one(model, clouds(len(z), count), z)
    found, parts = model.log_likelihood(clouds(len(z), 65), z, per_beam=True)
    assert model._last.together == 0
    for own, scan, one, each in zip(clouds(len(z), 65), z, found, parts, strict=True):
        expected, expected_parts = model.log_likelihood(own, scan, per_beam=True)
        assert differing(one, expected) == 0 and differing(each, expected_parts) == 0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize("kind", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_scans_with_readings_share_one_set_of_launches(kind, gpu, as_gpu, monkeypatch):
    device = Counting(as_gpu(gpu))
    model = kind(GRID, SCANNER, backend=device)
    z, poses = scans_of(), clouds(11, 50)
    model.log_likelihood(poses, z)
    kernels = {(gs.BeamModel, True): ("beam_tiles", "sum_parts"), (gs.BeamModel, False): ("score_beams",)}
    kernels |= {(gs.LikelihoodFieldModel, True): ("field_blocks", "sum_parts"),
                (gs.LikelihoodFieldModel, False): ("score_field",)}  # fmt: skip
    kernels = dict.fromkeys((*kernels[kind, gpu], "place_poses"), 1)

    def launches(times: int) -> None:
        found = {name: count for name, count in device.launches.items() if name in kernels}
        assert found == {name: times * count for name, count in kernels.items()}

    device.launches.clear()
    # Scans 3 and 4 have no reading that depends on the pose.
    model.log_likelihood(poses, z)
    launches(2)
    device.launches.clear()
    model.log_likelihood(poses[5:], z[5:])
    launches(1)
    # Launches of at most 150 particles, three scans each.
    monkeypatch.setattr(chunking, "CHUNK", 150)
    model = kind(GRID, SCANNER, backend=device)
    assert_as_one_by_one(model, poses, z)
    device.launches.clear()
    model.log_likelihood(poses[5:], z[5:])
    launches(2)
    # Each scan fills a launch.
    before = pipeline.TOGETHER
    monkeypatch.setattr(pipeline, "TOGETHER", {"cpu": 50 * BEAMS - 1, "gpu": 50 * BEAMS - 1})
    device.launches.clear()
    model.log_likelihood(poses[5:], z[5:])
    launches(6)
    assert model._last.together == 0 and before["gpu"] >= before["cpu"] > 50 * BEAMS


def test_threads_that_share_a_launch_find_each_particles_scan(needs, monkeypatch):
    """Pieces of a launch on Warp's processor begin and end within scans."""
    from gpusense.backends.warp import pieces as _warp_pieces

    model = field()(backend=get_backend(needs("warp:cpu")))
    z, poses = scans_of()[5:], clouds(6, 333)
    model.log_likelihood(poses, z)
    cut: list[int] = []
    piece = _warp_pieces.SharedLaunch._piece
    monkeypatch.setattr(_warp_pieces, "_PIECE_WORK", 50)
    monkeypatch.setattr(processor, "threads", lambda: 5)
    monkeypatch.setattr(
        _warp_pieces.SharedLaunch, "_piece", lambda self, *given: cut.append(given[2]) or piece(self, *given)
    )
    assert_as_one_by_one(model, poses, z)
    assert any(begin % 333 for begin in cut)


@pytest.mark.parametrize("kind", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_scans_that_do_not_fit_together_are_scored_one_by_one(kind, backend, monkeypatch):
    model = kind(GRID, SCANNER, backend=backend)
    z, poses = scans_of(), clouds(11, 50)
    expected = np.stack([model.log_likelihood(own, scan) for own, scan in zip(poses, z, strict=True)])
    empty = Workspace.empty

    def refuse(self, name, count, dtype, *, zero=False):
        if name in ("pose", "log_p") and count > 4 * 100:
            raise MemoryError("more than 400 do not fit")
        return empty(self, name, count, dtype, zero=zero)

    monkeypatch.setattr(Workspace, "empty", refuse)
    assert differing(model.log_likelihood(poses, z), expected) == 0
    assert model._last.together == 0


def test_a_pose_that_is_not_finite_is_named_by_its_scan(backend):
    model = field()(backend=backend)
    poses = clouds(6, 50)
    poses[4, 7, 1] = np.nan
    message = r"^poses: every value must be finite, got nan at index \(4, 7, 1\)$"
    for given in (poses, poses.tolist()):
        with pytest.raises(ValueError, match=message):
            model.log_likelihood(given, scans_of()[5:])
    for given, shape in ((poses[:5], r"\(5, 50, 3\)"), (poses[..., :2], r"\(6, 50, 2\)"), (poses[0], r"\(50, 3\)")):
        with pytest.raises(ValueError, match=rf"^poses: shape must be \(6, N, 3\), got {shape}$"):
            model.log_likelihood(given, scans_of()[5:])
    assert_as_one_by_one(model, clouds(6, 50), scans_of()[5:])


def test_other_numbers_and_lists_as_poses():
    model = field()(backend="numpy")
    poses = np.arange(2 * 4 * 3).reshape(2, 4, 3) % 5
    expected = model.log_likelihood(poses.astype(np.float64), scans_of()[:2])
    for given in (poses, poses.tolist(), poses.astype(np.float32), poses.astype(float)[:, ::-1][:, ::-1]):
        assert differing(model.log_likelihood(given, scans_of()[:2]), expected) == 0
