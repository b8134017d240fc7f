"""Sonar against single rays: cones, and surfaces without return beyond an angle of incidence."""

from __future__ import annotations

import copy
import itertools
import math
import pickle

import numpy as np
import pytest
from support.incidence_world import EDGES, INCIDENCE, KINDS, P, place
from support.selection import on_every_backend

import gpusense as gs
from gpusense.evaluation.tolerances import differing, per_beam, per_scan
from gpusense.evaluation.worlds import simulate_scan
from gpusense.models.scan.densities import log_mixture
from gpusense.tables.casters import CASTERS, Lookup

RANGE = 5.0
RING = np.arange(8) * math.pi / 4 + 0.1
MOUNT = (0.2, 0.1, 0.3)
SONAR = dict(cone=0.5, cone_rays=7, critical_incidence=0.6)


def ring(**options) -> gs.Scanner:
    return gs.Scanner(RING, RANGE, mount=MOUNT, **options)


def rays_alone(scanner: gs.Scanner) -> gs.Scanner:
    """Return a laser along every ray of a sonar."""
    return gs.Scanner(scanner.ray_bearings.ravel(), scanner.range_max, mount=scanner.mount)


def brute_force(scanner: gs.Scanner, backend, poses: np.ndarray, **options) -> tuple[np.ndarray, np.ndarray]:
    """Return the range of the nearest ray that returns, and its angle of incidence, from single rays."""
    model = gs.BeamModel(place()[0], rays_alone(scanner), backend=backend, **options)
    shape = (len(poses), *scanner.ray_bearings.shape)
    ranges = model.expected_ranges(poses).reshape(shape)
    angles = np.full(shape, np.nan, ranges.dtype)
    if "caster" not in options:
        angles = model.incidence(poses).reshape(shape)
    critical = scanner.critical_incidence
    if critical is not None:
        assert not np.isclose(angles, critical, rtol=0, atol=2e-6).any()
        ranges = np.where(angles > critical, ranges.dtype.type(scanner.range_max), ranges)
    which = ranges.argmin(axis=-1)[..., None]
    nearest = np.take_along_axis(ranges, which, axis=-1)[..., 0]
    return nearest, np.where(nearest < scanner.range_max, np.take_along_axis(angles, which, axis=-1)[..., 0], np.nan)


SONARS = {
    "cone": dict(cone=0.5, cone_rays=7),
    "even cone": dict(cone=0.26, cone_rays=4),
    "mirrors": SONAR,
    "laser and mirrors": dict(critical_incidence=0.6),
}


@pytest.mark.long_on("warp")
@on_every_backend(on_warp=lambda name: name in ("cone", "mirrors"), name=SONARS)
def test_a_sonar_hears_the_nearest_ray_that_returns(name, backend):
    grid, poses, _ = place()
    scanner = ring(**SONARS[name])
    several = backend == "numpy" or name == "mirrors"
    for outside, precision in itertools.product(("free", "occupied"), ("float32", "float64")):
        if (outside, precision) != ("free", "float32") and (not several or backend.startswith("warp")):
            continue
        options = dict(outside=outside, precision=precision)
        model = gs.BeamModel(grid, scanner, backend=backend, **options)
        ranges, angles = brute_force(scanner, backend, poses, **options)
        found = model.expected_ranges(poses)
        assert differing(found, ranges) == 0
        assert differing(model.incidence(poses), angles) == 0
        assert differing(model.expected_ranges(poses[3:4]), ranges[3:4]) == 0
        assert 0.001 < np.mean(found == RANGE) < 0.95


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@on_every_backend(
    on_warp=lambda caster: caster in ("bresenham", "lookup"), caster=[name for name in CASTERS if name != "exact"]
)
def test_cones_of_every_caster(caster, backend):
    if caster == "lookup":
        caster = Lookup(24)
    grid, poses, _ = place()
    scanner = ring(cone=0.5, cone_rays=3)
    found = gs.BeamModel(grid, scanner, caster=caster, backend=backend).expected_ranges(poses)
    assert differing(found, brute_force(scanner, backend, poses, caster=caster)[0]) == 0


def a_scan() -> np.ndarray:
    return np.array([1.0, 2.5, np.nan, 0.3, np.inf, 4.0, 3.1, 1.7])


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("incidence", [None, INCIDENCE], ids=["plain", "by incidence"])
def test_scores_are_the_mixture_at_what_a_sonar_hears(incidence, backend):
    grid, poses, _ = place()
    scanner = ring(**SONAR)
    z, options = a_scan(), dict(backend=backend, **({} if incidence is None else {"incidence": incidence}))
    model = gs.BeamModel(grid, scanner, **options)
    ranges, angles = brute_force(scanner, backend, poses)
    kinds = (P(),) if incidence is None else KINDS
    which = np.searchsorted(EDGES[1:-1], np.nan_to_num(angles), side="right") if incidence else np.zeros(ranges.shape)
    read, truth = np.broadcast_to(z.astype(np.float32).astype(float), ranges.shape), np.zeros(ranges.shape)
    for i, p in enumerate(kinds):
        each = log_mixture(np.nan_to_num(read, posinf=0.0), ranges.astype(float), range_max=RANGE, **p.to_dict())
        each = np.where(np.isinf(read), math.log(p.z_max), np.where(np.isnan(read), 0.0, each))
        truth = np.where(which == i, each, truth)
    log_p, parts = model.log_likelihood(poses, z, per_beam=True)
    assert (np.abs(parts - truth) <= 3 * per_beam(truth, "float32")).all()
    assert (np.abs(log_p - truth.sum(axis=1)) <= 3 * per_scan(truth, "float32")).all()
    whole = gs.BeamModel(grid, scanner, specialize=False, **options).log_likelihood(poses, z)
    assert (np.abs(whole - truth.sum(axis=1)) <= 3 * per_scan(truth, "float32")).all()
    title = model.explain().splitlines()[0]
    assert "cones of 7 rays, no return beyond 0.6 rad of incidence" in title and "CONES" in model.explain()


# ------------------------------------------------------------------------------------------------- laws of cones


def test_a_cone_of_one_ray_is_a_laser(backend):
    grid, poses, _ = place()
    laser = gs.BeamModel(grid, ring(), backend=backend)
    for options in (dict(cone=0.5, cone_rays=1), dict(cone=0.0, cone_rays=9), dict(critical_incidence=math.pi / 2)):
        one = gs.BeamModel(grid, ring(**options), backend=backend)
        assert differing(one.expected_ranges(poses), laser.expected_ranges(poses)) == 0
        assert differing(one.log_likelihood(poses, a_scan()), laser.log_likelihood(poses, a_scan())) == 0
        assert "CONES" not in one._last.flags


# ------------------------------------------------------------------------------------------------- the scanner


def test_scanners_are_equal_by_their_cones_too():
    scanner = ring(**SONAR)
    for twin in (ring(**SONAR), copy.deepcopy(scanner), pickle.loads(pickle.dumps(scanner))):
        assert twin == scanner and hash(twin) == hash(scanner) and repr(twin) == repr(scanner)
    for change in (dict(cone=0.4), dict(cone_rays=8), dict(critical_incidence=None), dict(critical_incidence=0.5)):
        assert ring(**(SONAR | change)) != scanner
    assert ring(cone=0.0, cone_rays=4) == ring()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (dict(cone=7.0), ValueError, "cone: must be finite and >= 0 and <= 6.28"),
        (dict(cone=0.2, cone_rays=0), ValueError, "cone_rays: must be >= 1 and <= 1024, got 0"),
        (dict(critical_incidence=1.6), ValueError, "critical_incidence: must be finite and > 0 and <= 1.57"),
    ],
)
def test_cones_that_are_none(options, error, message):
    with pytest.raises(error, match=message):
        ring(**options)


def test_mirrors_need_an_exact_caster():
    with pytest.raises(ValueError, match=r"caster: must be an exact one for a scanner with critical_incidence = 0\.6"):
        gs.BeamModel(place()[0], ring(**SONAR), caster="march", backend="numpy")


def test_the_likelihood_field_takes_the_axes(backend):
    grid, poses, _ = place()
    sonar, laser = (gs.LikelihoodFieldModel(grid, ring(**o), backend=backend) for o in (SONAR, {}))
    assert differing(sonar.log_likelihood(poses, a_scan()), laser.log_likelihood(poses, a_scan())) == 0


def test_simulated_scans_come_from_cones():
    grid, poses, _ = place()
    scanner, pose = ring(**SONAR), poses[40]
    sharp = P(1.0, 0.0, 0.0, 0.0, sigma_hit=1e-6)
    z = simulate_scan(grid, scanner, pose, sharp, np.random.default_rng(0))
    np.testing.assert_allclose(z, brute_force(scanner, "numpy", poses, precision="float64")[0][40], atol=1e-5)
