"""Same bits: does a change of the code leave every number that the package computes as it was?

    PYTHONPATH=old python bench/studies/same_bits.py record --rays 2000000 --models 15000 --output old.json
    PYTHONPATH=new python bench/studies/same_bits.py record --rays 2000000 --models 15000 --output new.json
    python bench/studies/same_bits.py compare old.json new.json

``record`` draws cases from fixed seeds, runs them with the package that Python finds, through its public interface
alone, and keeps a digest of every result: rays by every caster, likelihoods by every model in many configurations,
bound calls, arrays on the device, tables of maps. ``compare`` says what differs; exit code 1 where anything does.

Maps, poses and readings are drawn to be awkward, as in bench/fuzz_rays.py. A case depends on its configuration and its
number alone, and cases of a configuration share models, so ``--part 0/4`` to ``--part 3/4`` may run beside each other;
``compare old.json new-0.json new-1.json ...`` takes parts together. Run both sides on one machine with the same
options. ``--as-gpu`` (OpenCL) lets a processor pass for a GPU, whose launches are others: this alone reaches for a name
that is not public, ``gpusense.backends.get_backend``. ``--only`` takes the configurations with these words in their
names.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import platform
import shlex
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs

try:
    from gpusense import casters
except ImportError:
    casters = None  # type: ignore[assignment]

Outcome = Iterator[tuple[str, Any]]
Kinds = dict[str, dict[str, Any]]

# Rays of a case, and the cases that share a model.
POSES_OF_RAYS, BEARINGS_OF_RAYS, ROUND = 150, 44, 10
# Particle-beams of an ordinary case, and those from which GPUs put particles in an order.
ORDINARY, LARGE = 40_000, 1 << 22
SHOWN = 3
# z_hit, z_short, z_max, z_rand, sigma_hit and lambda_short.
MIXTURES = {
    "book": (0.7, 0.1, 0.1, 0.1, 0.05, 0.2),
    "hit": (1.0, 0.0, 0.0, 0.0, 0.2, 0.2),
    "hit sharp": (1.0, 0.0, 0.0, 0.0, 1e-4, 0.2),
    "short": (0.0, 1.0, 0.0, 0.0, 0.05, 0.5),
    "max": (0.0, 0.0, 1.0, 0.0, 0.05, 0.2),
    "rand": (0.0, 0.0, 0.0, 1.0, 0.05, 0.2),
    "hit short": (0.5, 0.5, 0.0, 0.0, 0.1, 0.2),
    "hit max": (0.6, 0.0, 0.4, 0.0, 0.1, 0.2),
    "hit rand": (0.9, 0.0, 0.0, 0.1, 0.02, 0.2),
    "short rand": (0.0, 0.5, 0.0, 0.5, 0.05, 1.0),
    "no rand": (0.8, 0.1, 0.1, 0.0, 0.05, 0.2),
    "sharp": (0.7, 0.1, 0.1, 0.1, 1e-3, 0.2),
    "peak": (0.7, 0.1, 0.1, 0.1, 1e-7, 0.2),
    "faint rand": (0.8, 0.1, 0.1, 1e-32, 0.05, 0.2),
    "flat short": (0.5, 0.2, 0.1, 0.2, 0.05, 0.0),
    "steep short": (0.5, 0.2, 0.1, 0.2, 0.05, 60.0),
    "wide": (0.7, 0.1, 0.1, 0.1, 300.0, 0.2),
}


@dataclasses.dataclass
class World:
    """A map, a scanner, and what it would measure at one pose."""

    grid: gs.OccupancyGrid
    scanner: gs.Scanner
    pose: np.ndarray
    truth: np.ndarray


@dataclasses.dataclass
class Device:
    """Name a device: the backend that models take; ``there`` copies an array to it, ``change`` writes into one."""

    backend: Any
    there: Callable[[np.ndarray], Any] | None
    change: Callable[[Any, np.ndarray], None] | None
    gpu: bool


@dataclasses.dataclass
class Case:
    """Hold the arguments of an action."""

    rng: np.random.Generator
    device: Device
    config: dict[str, Any]
    world: World
    models: list[Any]

    @property
    def model(self) -> Any:
        """Return the first model."""
        return self.models[0]


# --- What is drawn ----------------------------------------------------------------------------------------------------


def draw_grid(rng: np.random.Generator, most: float = 2.7, resolutions: tuple[float, ...] = ()) -> gs.OccupancyGrid:
    """Draw a map to trip over, of up to 10 ** most cells on a side."""
    rows, cols = (int(n) for n in np.ceil(10 ** rng.uniform(0, most, 2)))
    density = rng.choice([0.0, 0.002, 0.02, 0.2, 0.7, 1.0], p=[0.05, 0.3, 0.3, 0.2, 0.1, 0.05])
    cells = np.where(rng.random((rows, cols)) < density, 100, 0)
    cells[rng.random((rows, cols)) < 0.02] = -1
    if rng.random() < 0.5:
        wall = np.arange(min(rows, cols))
        cells[wall, wall if rng.random() < 0.5 else cols - 1 - wall] = 100
    resolution = float(rng.choice(resolutions or [1e-3, 0.05, 0.1, 1.0, 100.0]))
    far = rng.random() < 0.3
    origin = (*rng.uniform(-5e6, 5e6, 2), rng.uniform(-3, 3)) if far else (0.0, 0.0, float(rng.choice([0.0, 0.7])))
    return gs.OccupancyGrid(cells, resolution, origin)


def in_world(grid: gs.OccupancyGrid, col: np.ndarray, row: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Move poses from cells of a map to the world."""
    cos, sin = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    x, y = col * grid.resolution, row * grid.resolution
    return np.stack([grid.origin[0] + cos * x - sin * y, grid.origin[1] + sin * x + cos * y, theta], axis=-1)


def draw_poses(rng: np.random.Generator, grid: gs.OccupancyGrid, count: int, huge: float, out: float) -> np.ndarray:
    """Draw poses in, on the edges of, and around the map; some of them with headings of many turns."""
    rows, cols = grid.shape
    reach = out * (0.3 * np.array([cols, rows]) + 2)
    col, row = rng.uniform(-reach[0], cols + reach[0], count), rng.uniform(-reach[1], rows + reach[1], count)
    on_edge = rng.random((2, count)) < 0.25
    col, row = np.where(on_edge[0], np.rint(col), col), np.where(on_edge[1], np.rint(row), row)
    theta = rng.uniform(-np.pi, np.pi, count)
    theta = np.where(rng.random(count) < 0.25, np.rint(theta / (np.pi / 4)) * (np.pi / 4), theta)
    theta = np.where(rng.random(count) < huge, theta + 1e6, theta)
    return in_world(grid, col, row, theta)


def draw_cloud(case: Case, count: int) -> np.ndarray:
    """Draw poses around the true one, all over and beyond the map, or within it."""
    rng, world = case.rng, case.world
    huge = 0.1 * case.config.get("huge", 0)
    way = rng.choice(3, p=[0.5, 0.3, 0.2])
    if way == 0:
        spread = world.grid.resolution * 10 ** rng.uniform(-2, 1)
        cloud = world.pose + rng.standard_normal((count, 3)) * [spread, spread, 0.05]
        cloud[:, 2] += np.where(rng.random(count) < huge, 1e6, 0.0)
        return cloud
    return draw_poses(rng, world.grid, count, huge, float(way == 1))


def draw_scanner(rng: np.random.Generator, grid: gs.OccupancyGrid, wanted: dict[str, Any]) -> gs.Scanner:
    """Draw a scanner of up to 400 beams; what is wanted of it is as it is wanted."""
    options = dict(wanted)
    few = int(10 ** rng.uniform(0, 2.6))
    count = int(rng.choice([few, 0, 1, 17, 64, 65, 129, 181, 400], p=[0.65, 0.01, 0.04, *[0.05] * 6]))
    step = rng.choice([2 * np.pi / max(count, 1), 0.0174, np.pi / 4 * 1e-2])
    bearings = rng.uniform(-np.pi, np.pi) + np.arange(count) * step
    if rng.random() < 0.2:
        bearings = rng.uniform(-np.pi, np.pi, count)
    if options.pop("repeat", False):
        bearings = bearings[rng.integers(max(count // 3, 1), size=count)]
    elif rng.random() < 0.1:
        bearings = np.arange(count) * (np.pi / 4)
    range_max = options.pop("range_max", grid.resolution * float(10 ** rng.uniform(0.3, 2.5)))
    range_min = range_max * options.pop("nearest", 0.0)
    mount = tuple(grid.resolution * 5 * np.array(options.pop("mount"))) if "mount" in options else (0.0, 0.0, 0.0)
    turned = (*mount[:2], mount[2] / grid.resolution / 5)
    return gs.Scanner(bearings, range_max, range_min, turned, **options)


def walk(grid: gs.OccupancyGrid, scanner: gs.Scanner, pose: np.ndarray) -> np.ndarray:
    """Find roughly what a scanner would measure, by steps of a quarter of a cell; in no way by the package's code."""
    x, y, turn = scanner.mount
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = pose[0] + cos * x - sin * y - grid.origin[0], pose[1] + sin * x + cos * y - grid.origin[1]
    cos, sin = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    col, row = (cos * dx + sin * dy) / grid.resolution, (cos * dy - sin * dx) / grid.resolution
    angle = pose[2] + turn + scanner.bearings[:, None] - grid.origin[2]
    steps = np.arange(0, min(scanner.range_max / grid.resolution, sum(grid.shape)), 0.25)
    cols, rows = (np.floor(col + steps * np.cos(angle)), np.floor(row + steps * np.sin(angle)))
    inside = (cols >= 0) & (cols < grid.shape[1]) & (rows >= 0) & (rows < grid.shape[0])
    at = np.where(inside, rows, 0).astype(int), np.where(inside, cols, 0).astype(int)
    met = inside & (grid.cells[at] >= 65)
    return np.where(met.any(axis=1), steps[np.argmax(met, axis=1)] * grid.resolution, scanner.range_max)


def draw_world(rng: np.random.Generator, config: dict[str, Any]) -> World:
    """Draw a map and a scanner, and where the scanner is."""
    grid = draw_grid(rng, config.get("most", 2.0), config.get("resolutions", (0.05, 0.05, 0.1, 0.1, 1.0, 1e-3)))
    scanner = draw_scanner(rng, grid, config.get("scanner", {}))
    rows, cols = grid.shape
    where = rng.uniform(0, cols, 1), rng.uniform(0, rows, 1), rng.uniform(-np.pi, np.pi, 1)
    pose = in_world(grid, *where)[0]
    return World(grid, scanner, pose, walk(grid, scanner, pose))


def draw_readings(rng: np.random.Generator, world: World, scans: int | None = None) -> np.ndarray:
    """Draw a scan, or several: what is there, anything at all, and readings that need care."""
    top, shape = world.scanner.range_max, (*(() if scans is None else (scans,)), world.scanner.count)
    z = world.truth + rng.standard_normal(shape) * world.grid.resolution * rng.choice([1e-3, 0.5, 2.0])
    z = np.where(rng.random(shape) < 0.1, rng.uniform(0, top, shape), z)
    near = (top * (1 - 1e-9), float(np.nextafter(top, 0)), float(np.float32(top)), world.scanner.range_min)
    special = np.array([np.nan, np.inf, -np.inf, 0.0, top, 2 * top, -1.0, *near])
    often = rng.choice([0.05, 0.5, 1.0], p=[0.92, 0.06, 0.02])
    z = np.where(rng.random(shape) < often, special[rng.integers(len(special), size=shape)], z)
    if rng.random() < 0.03:
        z[...] = special[rng.integers(5)]
    return z.astype(np.float32) if rng.random() < 0.25 else z


def draw_count(case: Case) -> int:
    """Draw how many particles: none to a few thousand, at times more than several scans of one launch may have."""
    rng, rays = case.rng, max(case.world.scanner.count * case.world.scanner.cone_rays, 1)
    if rng.random() < 0.01:
        return 0
    if rng.random() < 0.003 and "slow" not in case.config:
        return (1 << 20) // rays % 6000 + 1
    return max(min(int(10 ** rng.uniform(0, 3.6)), ORDINARY // rays), 1)


# --- Configurations ---------------------------------------------------------------------------------------------------


def knobs(name: str, **values: Any) -> Any:
    """Return a caster with knobs of its own, or its name where they cannot be had."""
    return name.lower() if casters is None else getattr(casters, name)(**values)


@functools.cache
def learned() -> Any:
    """Learn a discrete model from a small simulated set."""
    rng = np.random.default_rng(5)
    expected = rng.uniform(0.2, 12.0, 4000)
    ranges = expected + 0.1 * rng.standard_normal(4000)
    ranges = np.where(rng.random(4000) < 0.15, rng.exponential(4.0, 4000), ranges)
    return gs.DiscreteBeamModel.learn(np.where(rng.random(4000) < 0.05, np.inf, ranges), expected, 10.0, bins=60)


def beam(name: str = "book", scanner: dict[str, Any] | None = None, **options: Any) -> dict[str, Any]:
    """Return a configuration of a beam model; what does not concern the model stands beside its options."""
    own = {key: options.pop(key) for key in ("most", "slow", "resolutions", "bins") if key in options}
    if not {"incidence", "compat", "parameters"} & set(options):
        options["parameters"] = gs.BeamParameters(*MIXTURES[name])
    return {"kind": "scan", "class": gs.BeamModel, "options": options, "scanner": scanner or {}, **own}


def beam_mixtures() -> Kinds:
    """Return every mixture in both precisions."""
    found = {f"beam {name}": beam(name) for name in MIXTURES}
    wide = ("book", "hit", "hit sharp", "no rand", "peak", "short rand", "max", "faint rand")
    return found | {f"beam64 {name}": beam(name, precision="float64") for name in wide}


def beam_casters() -> Kinds:
    """Return beam models with each caster, and with both policies."""
    both = {"unknown": "occupied", "outside": "occupied"}
    tables = {"most": 1.6, "slow": True}
    return {
        "beam dda": beam(caster="dda"),
        "beam march": beam(caster="march", outside="occupied"),
        "beam march centre": beam(caster=knobs("March", tolerance=0.02, rule="centre")),
        "beam bresenham": beam("no rand", caster="bresenham", unknown="occupied"),
        "beam cddt": beam(caster="cddt", **tables),
        "beam cddt pruned": beam("hit", caster=knobs("Cddt", bins=60, pruned=True), outside="occupied", **tables),
        "beam lookup": beam(caster="lookup", **tables),
        "beam lookup 64": beam(caster=knobs("Lookup", bins=64), outside="occupied", **tables),
        "beam64 dda": beam(caster="dda", precision="float64", **both),
        "beam64 march": beam(caster="march", precision="float64"),
        "beam64 cddt": beam(caster=knobs("Cddt", bins=90), precision="float64", **tables),
        "beam64 lookup": beam(caster="lookup", precision="float64", **tables),
        "beam occupied": beam(**both),
        "beam outside": beam("hit rand", outside="occupied"),
        "beam64 unknown": beam("hit short", unknown="occupied", precision="float64"),
    }


def beam_options() -> Kinds:
    """Return beam models with tables, other peers' weights, some of the beams, and nothing left out."""
    mounted = {"mount": (0.7, -0.4, 0.9)}
    discrete = {"scanner": {"range_max": 10.0}, "resolutions": (0.05, 0.1, 0.5)}
    separate = gs.DiscreteBeamModel(gs.BeamParameters(), 10.0, 40)
    return {
        "beam table": beam(bins=100),
        "beam table no rand": beam("no rand", bins=40, temperature=0.4),
        "beam64 table": beam(bins=333, precision="float64", scanner=mounted),
        "beam discrete": beam(parameters=learned(), **discrete),
        "beam discrete mixture": beam(parameters=separate, temperature=0.3, beams=9, **discrete),
        "beam64 discrete": beam(parameters=learned(), precision="float64", **discrete),
        "beam discrete all": beam(parameters=learned(), specialize=False, **discrete),
        "beam amcl": beam(compat="amcl"),
        "beam amcl exact": beam(compat="amcl", caster="exact", scanner={"nearest": 0.1}),
        "beam64 beluga": beam(compat="beluga", precision="float64"),
        "beam beluga": beam(compat="beluga", beams=30, scanner={"nearest": 0.05}),
        "beam temperature": beam(temperature=0.25, beams=12),
        "beam some": beam("no rand", beams="some", scanner=mounted),
        "beam repeated": beam(scanner={"repeat": True}),
        "beam64 repeated": beam("no rand", scanner={"repeat": True}, precision="float64", temperature=0.7),
        "beam mount": beam(scanner={**mounted, "nearest": 0.02}),
        "beam all": beam(specialize=False),
        "beam64 all": beam("no rand", specialize=False, precision="float64", scanner={"repeat": True}),
        "beam all hit": beam("hit", specialize=False, beams="some"),
        "beam table all": beam(bins=50, specialize=False, scanner={"repeat": True}),
    }


def beam_echoes() -> Kinds:
    """Return beam models with cones, surfaces that are mirrors, and parameters for each angle of incidence."""
    book, other = gs.BeamParameters(), gs.BeamParameters(0.5, 0.1, 0.1, 0.3, 0.2, 0.4)
    rarely = gs.BeamParameters(0.3, 0.0, 0.5, 0.2, 0.1, 0.2)
    edges = (0.0, 0.4, 1.0, math.pi / 2)
    same = gs.IncidenceParameters(edges[::2] + edges[3:], (book, other))
    depends = gs.IncidenceParameters(edges, (book, other, rarely))
    nothing = gs.IncidenceParameters(edges[::2] + edges[3:], (book, rarely), gs.BeamParameters(0.0, 0.1, 0.8, 0.1))
    cone, mirror = {"cone": 0.26, "cone_rays": 5}, {"cone": 0.3, "cone_rays": 3, "critical_incidence": 0.5}
    return {
        "beam cone": beam(scanner=cone),
        "beam cone all": beam(scanner={**cone, "repeat": True}, specialize=False),
        "beam cone march": beam("no rand", scanner=cone, caster="march"),
        "beam64 cone": beam(scanner={**mirror, "mount": (0.5, 0.2, -2.0)}, precision="float64"),
        "beam mirror": beam(scanner={"critical_incidence": 0.8}, unknown="occupied"),
        "beam mirror cone": beam(scanner=mirror, caster="dda"),
        "beam incidence": beam(incidence=same),
        "beam incidence max": beam(incidence=depends, outside="occupied"),
        "beam incidence nothing": beam(incidence=nothing, scanner=mirror),
        "beam64 incidence": beam(incidence=nothing, precision="float64"),
        "beam incidence all": beam(incidence=depends, specialize=False),
    }


def field(*weights: float, scanner: dict[str, Any] | None = None, **options: Any) -> dict[str, Any]:
    """Return a configuration of a likelihood field."""
    shape = {key: options.pop(key) for key in ("interpolation", "max_distance") if key in options}
    if "compat" not in options:
        options["parameters"] = gs.LikelihoodFieldParameters(*weights, **shape)
    return {"kind": "scan", "class": gs.LikelihoodFieldModel, "options": options, "scanner": scanner or {}}


def fields() -> Kinds:
    """Return likelihood fields."""
    mounted, smooth = {"mount": (-0.3, 0.8, 2.0)}, {"interpolation": "bilinear"}
    return {
        "field book": field(),
        "field hit": field(1.0, 0.0, 0.0, 0.05),
        "field rand": field(0.0, 0.0, 1.0),
        "field max": field(0.6, 0.3, 0.1, 0.1, max_distance=0.3),
        "field max only": field(0.0, 1.0, 0.0),
        "field sharp": field(0.9, 0.0, 0.1, 1e-3),
        "field huge": field(0.9, 0.0, 0.1, 5.0, max_distance=1e4, outside="occupied"),
        "field small": field(max_distance=0.01, unknown="occupied"),
        "field mount": field(scanner=mounted, temperature=0.2, beams=20),
        "field some": field(beams="some", outside="occupied", scanner={"nearest": 0.1}),
        "field repeated": field(0.8, 0.1, 0.1, scanner={"repeat": True}),
        "field all": field(0.8, 0.1, 0.1, specialize=False),
        "field64 book": field(precision="float64"),
        "field64 hit": field(1.0, 0.0, 0.0, 0.01, precision="float64", outside="occupied", unknown="occupied"),
        "field64 all": field(precision="float64", specialize=False, beams="some"),
        "field bilinear": field(**smooth),
        "field bilinear hit": field(1.0, 0.0, 0.0, 0.1, **smooth, scanner=mounted),
        "field bilinear sharp": field(0.8, 0.1, 0.1, 1e-3, **smooth, max_distance=0.5),
        "field bilinear all": field(0.8, 0.1, 0.1, 0.1, **smooth, specialize=False),
        "field64 bilinear": field(0.8, 0.1, 0.1, 0.02, **smooth, precision="float64", temperature=0.5),
        "field amcl": field(compat="amcl", scanner={"nearest": 0.1}),
        "field64 amcl": field(compat="amcl", precision="float64", beams=15),
        "field beluga": field(compat="beluga", scanner=mounted),
    }


def severals() -> Kinds:
    """Return calls of several models of one map."""
    members = {
        "several beams": [beam(), beam("no rand", caster="dda"), beam(precision="float64")],
        "several": [beam(), field(), field(0.8, 0.1, 0.1, precision="float64"), beam("hit rand", temperature=0.5)],
        "several fields": [field(), field(interpolation="bilinear"), field(compat="amcl")],
    }
    return {name: {"kind": "several", "members": each} for name, each in members.items()}


def landmarks() -> Kinds:
    """Return landmark models."""
    wide = {"sigma_range": 2.0, "sigma_bearing": 1.0}
    signed = {"sigma_signature": 0.5, "range_max": 15.0}
    made: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
        "nearest": ({}, {}),
        "nearest wide": (wide, {"negative": True, "mount": (0.3, -0.1, 0.5)}),
        "nearest view": ({"field_of_view": 2.0, "p_detect": 0.7}, {"negative": True, "temperature": 0.5}),
        "sum": ({}, {"association": "sum"}),
        "sum signatures": (signed, {"association": "sum", "precision": "float64"}),
        "joint": ({}, {"association": "joint"}),
        "joint negative": ({"field_of_view": 3.0, **signed}, {"association": "joint", "negative": True}),
        "signatures": (signed, {}),
        "ranges": ({"sigma_bearing": None, "z_detect": 1.0, "z_false": 0.0}, {}),
        "bearings": ({"sigma_range": None, "sigma_bearing": 1e-3}, {"precision": "float64"}),
        "all": ({}, {"specialize": False}),
        "64": (wide, {"precision": "float64", "negative": True}),
    }
    return {
        f"landmark {name}": {"kind": "landmark", "parameters": p, "options": options}
        for name, (p, options) in made.items()
    }


def points() -> Kinds:
    """Return models of position fixes, headings, beacons and bumpers."""
    region, tilted = (-100.0, -100.0, 100.0, 100.0), ((4.0, 1.5), (1.5, 1.0))
    made: dict[str, tuple[Any, Any, dict[str, Any]]] = {
        "position": (gs.PositionModel, gs.PositionParameters(sigma=0.5), {}),
        "position covariance": (
            gs.PositionModel, gs.PositionParameters(None, tilted, 0.9, 0.1, region, (0.3, 0.1)), {"temperature": 0.5}
        ),
        "position64": (gs.PositionModel, gs.PositionParameters(mount=(1.0, 0.0)), {"precision": "float64"}),
        "heading": (gs.HeadingModel, gs.HeadingParameters(), {}),
        "heading wide": (gs.HeadingModel, gs.HeadingParameters(sigma=2.5, z_hit=0.9, z_rand=0.1, offset=1.0), {}),
        "heading mises": (gs.HeadingModel, gs.HeadingParameters(kappa=4.0, kind="von_mises"), {"temperature": 0.3}),
        "heading64": (gs.HeadingModel, gs.HeadingParameters(sigma=0.01), {"precision": "float64"}),
        "beacon": (gs.BeaconModel, gs.BeaconParameters(), {}),
        "beacon t": (gs.BeaconModel, gs.BeaconParameters(kind="student_t", nu=3, bias=0.2, mount=(0.2, 0.1)), {}),
        "beacon mixture": (gs.BeaconModel, gs.BeaconParameters(kind="mixture", z_hit=1.0, z_rand=0.0), {}),
        "beacon64": (gs.BeaconModel, gs.BeaconParameters(kind="student_t"), {"precision": "float64"}),
        "bumper": (gs.BumperModel, gs.BumperParameters(), {"outline": 0.3}),
        "bumper arcs": (gs.BumperModel, gs.BumperParameters(), {"outline": 0.4, "segments": [[-1, 0], [0, 1], [1, 4]]}),
        "bumper box": (
            gs.BumperModel, gs.BumperParameters(1.0, 0.0, 0.2),
            {"outline": [[0.5, 0.3], [-0.5, 0.3], [-0.5, -0.3], [0.5, -0.3]], "outside": "occupied"},
        ),
        "bumper64": (gs.BumperModel, gs.BumperParameters(), {"outline": 0.2, "precision": "float64"}),
    }  # fmt: skip
    return {
        f"point {name}": {"kind": name.split()[0].rstrip("64"), "class": own, "parameters": p, "options": options}
        for name, (own, p, options) in made.items()
    }


def configurations() -> Kinds:
    """Return every configuration of models, by name; every fourth with huge headings, every third on a queue too."""
    found = beam_mixtures() | beam_casters() | beam_options() | beam_echoes() | fields() | severals() | landmarks()
    found |= points() | {"tables": {"kind": "tables"}}
    for i, config in enumerate(found.values()):
        config["huge"], config["there"] = i % 4 == 3, i % 3 == 2
    return found


# --- Actions: what a case does; labels and results --------------------------------------------------------------------


def score(case: Case) -> Outcome:
    """Score a scan in one of the ways in which its arrays may be given."""
    rng, real = case.rng, case.model.precision
    poses, ranges = draw_cloud(case, draw_count(case)), draw_readings(rng, case.world)
    way = rng.integers(8)
    if way == 0:
        poses = poses.astype(np.float32)
    elif way == 1 and len(poses) < 50:
        poses = poses.tolist()
    elif way == 2:
        poses = np.concatenate([poses, poses], axis=1)[:, ::-1][:, 3:]
    out = np.empty(len(poses), real) if way == 3 else None
    yield "log_p", case.model.log_likelihood(poses, ranges, out=out)
    if way == 4:
        yield "explain", case.model.explain()


def score_each(case: Case) -> Outcome:
    """Score a scan with what every beam adds."""
    poses, ranges = draw_cloud(case, draw_count(case)), draw_readings(case.rng, case.world)
    log_p, parts = case.model.log_likelihood(poses, ranges, per_beam=True)
    yield "log_p", log_p
    yield "parts", parts


def score_scans(case: Case) -> Outcome:
    """Score several scans, each with particles of its own."""
    scans = int(case.rng.choice([0, 1, 2, 3, 7], p=[0.02, 0.23, 0.25, 0.25, 0.25]))
    count = draw_count(case)
    count = count // max(scans, 1) if case.rng.random() < 0.9 else count
    poses = draw_cloud(case, scans * count).reshape(scans, count, 3)
    ranges = draw_readings(case.rng, case.world, scans)
    yield "log_p", case.model.log_likelihood(poses, ranges)
    if case.rng.random() < 0.2:
        log_p, parts = case.model.log_likelihood(poses, ranges, per_beam=True)
        yield "log_p again", log_p
        yield "parts", parts


def change_map(case: Case) -> None:
    """Replace some cells of a model's map."""
    rng, (rows, cols) = case.rng, case.world.grid.shape
    height, width = (int(rng.integers(1, min(size, 12) + 1)) for size in (rows, cols))
    cells = rng.choice([0, 100, -1], p=[0.6, 0.3, 0.1], size=(height, width))
    region = int(rng.integers(rows - height + 1)), int(rng.integers(cols - width + 1))
    for model in case.models:
        model.update_map(cells, region)


def score_changed(case: Case) -> Outcome:
    """Score a scan before and after cells of the map are replaced."""
    poses, ranges = draw_cloud(case, draw_count(case)), draw_readings(case.rng, case.world)
    yield "before", case.model.log_likelihood(poses, ranges)
    change_map(case)
    yield "after", case.model.log_likelihood(poses, ranges)


def score_bound(case: Case) -> Outcome:
    """Repeat a bound call while its arrays and the map change."""
    rng, real = case.rng, case.model.precision
    poses, ranges = draw_cloud(case, draw_count(case)), draw_readings(rng, case.world)
    poses = poses.astype(np.float32) if rng.random() < 0.3 else poses
    call = case.model.bind(poses, ranges, out=np.empty(len(poses), real) if rng.random() < 0.3 else None)
    yield "first", call().copy()
    poses[:, 2] += 0.1
    yield "poses", call().copy()
    ranges[...] = draw_readings(rng, case.world)
    yield "ranges", call().copy()
    if rng.random() < 0.5:
        change_map(case)
        yield "map", call().copy()
        yield "ordinary", case.model.log_likelihood(poses, ranges)
    call.check()
    if rng.random() < 0.1:
        poses[len(poses) // 2 :, 1] = np.nan
        yield "bad", call()


def score_there(case: Case) -> Outcome:
    """Score a scan with arrays on the device, and repeat it as a bound call."""
    rng, device = case.rng, case.device
    poses, ranges = draw_cloud(case, draw_count(case)), draw_readings(rng, case.world)
    poses = poses.astype(np.float32) if rng.random() < 0.3 else poses
    if device.there is None or device.change is None:
        return
    own_poses, own_ranges = device.there(poses), device.there(ranges)
    yield "log_p", case.model.log_likelihood(own_poses, ranges)
    yield "both", case.model.log_likelihood(own_poses, own_ranges)
    if rng.random() < 0.2 and isinstance(case.model, gs.BeamModel):
        yield "expected", case.model.expected_ranges(own_poses)
    call = case.model.bind(own_poses, own_ranges)
    yield "first", on_host(call())
    call.check()
    poses[:, 2] += 0.1
    device.change(own_poses, poses)
    device.change(own_ranges, draw_readings(rng, case.world).astype(ranges.dtype))
    yield "again", on_host(call())
    if rng.random() < 0.5:
        change_map(case)
        yield "map", on_host(call())
    call.check()


def expect(case: Case) -> Outcome:
    """Find expected ranges and angles of incidence."""
    poses = draw_cloud(case, draw_count(case))
    if not isinstance(case.model, gs.BeamModel):
        yield "log_p", case.model.log_likelihood(poses, draw_readings(case.rng, case.world))
        return
    yield "expected", case.model.expected_ranges(poses)
    if case.rng.random() < 0.3:
        yield "incidence", case.model.incidence(poses)


def score_large(case: Case) -> Outcome:
    """Score the number of particles from which GPUs sort them; skip devices that are not GPUs, which are too slow."""
    rays = max(case.world.scanner.count, 1)
    if not case.device.gpu or "slow" in case.config or rays < 64:
        yield from score(case)
        return
    poses, ranges = draw_cloud(case, max(LARGE // rays, 1 << 12) + 77), draw_readings(case.rng, case.world)
    yield "log_p", case.model.log_likelihood(poses, ranges)
    if case.device.there is not None:
        call = case.model.bind(case.device.there(poses), case.device.there(ranges))
        yield "bound", on_host(call())
        call.check()


def refuse(case: Case) -> Outcome:
    """Give a model what it must refuse."""
    poses, ranges = draw_cloud(case, 5), draw_readings(case.rng, case.world)
    way = case.rng.integers(6)
    if way == 0:
        poses[3, 1] = np.nan
    elif way == 1:
        ranges = np.append(ranges, 1.0)
    elif way == 2:
        poses = poses[:, :2]
    elif way == 3:
        yield "empty", case.model.log_likelihood(poses[:0], ranges)
        poses = poses[None]
    elif way == 4:
        case.model.update_map(np.zeros((2, 2), int), (case.world.grid.shape[0] - 1, 0))
    else:
        yield "bind", case.model.bind(poses.tolist(), ranges)()
    yield "log_p", case.model.log_likelihood(poses, ranges)


SCAN_ACTIONS: dict[Callable[[Case], Outcome], float] = {
    score: 0.44, score_each: 0.08, score_scans: 0.12, score_changed: 0.08, score_bound: 0.1, score_there: 0.07,
    expect: 0.07, score_large: 0.02, refuse: 0.02,
}  # fmt: skip


def act_scan(case: Case) -> Outcome:
    """Do something with a model of a scan."""
    action = case.rng.choice(np.array(list(SCAN_ACTIONS)), p=list(SCAN_ACTIONS.values()))
    if case.device.there is not None and case.rng.random() < 0.3:
        action = score_there
    yield action.__name__, ""
    yield from action(case)


def act_several(case: Case) -> Outcome:
    """Score by several models at once: one cloud and scan for all, or others for each."""
    rng = case.rng
    scans = int(rng.integers(2, 5)) if rng.random() < 0.2 else None
    count = draw_count(case)
    poses: Any = draw_cloud(case, count)
    if scans is not None:
        poses = poses[: count // scans * scans].reshape(scans, -1, 3) if count >= scans else np.zeros((scans, 0, 3))
    ranges: Any = draw_readings(rng, case.world, scans)
    if rng.random() < 0.3 and scans is None:
        poses = [draw_cloud(case, draw_count(case)) for _ in case.models]
    if rng.random() < 0.3:
        ranges = [draw_readings(rng, case.world, scans) for _ in case.models]
    for i, log_p in enumerate(gs.log_likelihoods(case.models, poses, ranges)):
        yield f"log_p {i}", log_p
    if rng.random() < 0.1:
        change_map(case)
        yield "changed", np.concatenate(gs.log_likelihoods(case.models, draw_cloud(case, 20), case.world.truth))


def act_landmark(case: Case) -> Outcome:
    """Score features by landmarks: known, unknown, and which they are."""
    rng, model = case.rng, case.model
    joint = model.association == "joint"
    poses = case.world.pose + rng.standard_normal((int(10 ** rng.uniform(0, 2 if joint else 3.3)), 3)) * [1, 1, 0.3]
    poses[:, 2] += np.where(rng.random(len(poses)) < 0.1 * case.config["huge"], 1e6, 0.0)
    count = int(rng.choice([0, 1, 2, 3, 5, 8, 9, 30], p=[0.04, 0.16, 0.2, 0.2, 0.2, 0.1, 0.05, 0.05]))
    features, known = draw_features(rng, case, count)
    way = rng.integers(8)
    if way < 2 and len(model.landmarks):
        yield "known", model.log_likelihood(poses, features, known)
    elif way == 2:
        which, parts = model.associate(poses, features)
        yield "which", which
        yield "parts", parts
    elif way == 3 and case.device.there is not None:
        yield "there", model.log_likelihood(case.device.there(poses), features)
    else:
        yield "log_p", model.log_likelihood(poses, features)
    if way == 4:
        yield "explain", model.explain()


def draw_features(rng: np.random.Generator, case: Case, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw features as they are seen, false ones, and some of which parts are missing or impossible."""
    landmarks = case.model.landmarks
    if not len(landmarks):
        return rng.uniform(0, 3, (count, 2)), np.full(count, -1)
    known = rng.integers(len(landmarks), size=count)
    away = landmarks.xy[known] - case.world.pose[:2]
    ranges, bearings = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0]) - case.world.pose[2]
    features = np.stack([ranges + 0.1 * rng.standard_normal(count), bearings + 0.03 * rng.standard_normal(count)], 1)
    if landmarks.signatures is not None:
        own = landmarks.signatures[known] + 0.3 * rng.standard_normal(count)
        features = np.concatenate([features, own[:, None]], axis=1)
    odd = rng.random(features.shape) < 0.06
    features[odd] = rng.choice([np.nan, np.inf, -1.0, 1e3, 2.0], size=int(odd.sum()))
    return features, np.where(rng.random(count) < 0.2, -1, known)


def act_point(case: Case) -> Outcome:
    """Score a fix, a heading, ranges to beacons or a bumper."""
    rng, kind, model = case.rng, case.config["kind"], case.model
    poses = draw_cloud(case, int(10 ** rng.uniform(0, 3.6)))
    odd = rng.choice([0.0, np.nan, np.inf], p=[0.9, 0.05, 0.05])
    options: dict[str, Any] = {}
    if kind == "position":
        reading: Any = case.world.pose[:2] + rng.standard_normal(2) + odd
        if rng.random() < 0.3 or model.parameters.sigma is model.parameters.covariance:
            options["covariance"] = np.array([[2.0, 0.3], [0.3, 0.5]]) * 10 ** rng.uniform(-3, 3)
    elif kind == "heading":
        reading = case.world.pose[2] + rng.choice([0.0, 0.1, 3.0, 2e5]) * rng.standard_normal() + odd
    elif kind == "beacon":
        options["ids"] = rng.integers(len(model.xy), size=int(rng.integers(0, 9)))
        reading = np.hypot(*(model.xy[options["ids"]] - case.world.pose[:2]).T) * rng.choice([0.1, 0.99, 1.0, 3.0])
        reading = np.where(rng.random(len(reading)) < 0.1, np.nan, reading + 0.2 * rng.standard_normal(len(reading)))
    else:
        reading = [(True, False, math.nan)[i] for i in rng.choice(3, p=[0.4, 0.5, 0.1], size=model.segments)]
    if rng.random() < 0.2 and case.device.there is not None:
        yield "there", model.log_likelihood(case.device.there(poses), reading, **options)
    elif rng.random() < 0.1:
        options["out"] = np.empty(len(poses), model.precision)
    yield "log_p", model.log_likelihood(poses, reading, **options)
    if rng.random() < 0.1:
        yield "explain", model.explain()


def act_tables(case: Case) -> Outcome:
    """Make tables of a map."""
    rng, grid = case.rng, draw_grid(case.rng, 2.3)
    kinds: list[Any] = ["free", "occupied"]
    yield "distances", gs.distance_transform(grid.occupied, squared=True, backend=case.device.backend)
    if rng.random() < 0.5:
        yield "normals", gs.surface_normals(grid, unknown=rng.choice(kinds), outside=rng.choice(kinds))
    ranges, world = rng.uniform(-1, 12, 50), case.world
    yield "classes", gs.classify(draw_readings(rng, world), world.scanner)
    if rng.random() < 0.05:
        yield "discrete", learned().log_likelihood(ranges, np.abs(ranges))


def act_rays(case: Case) -> Outcome:
    """Cast rays by one way to find them; most by the exact one in float32."""
    rng = case.rng
    ways = ["exact", "dda", "march", knobs("March", tolerance=0.01, rule="centre"), "bresenham", "cddt", "lookup"]
    ways += [knobs("March", tolerance=1.0), knobs("Cddt", bins=36, pruned=True), knobs("Lookup", bins=48)]
    way = ways[int(rng.choice(len(ways), p=[0.64, *[0.04] * 9]))]
    name = way if isinstance(way, str) else way.name
    policy = {"outside": str(rng.choice(["free", "occupied"])), "unknown": str(rng.choice(["free", "occupied"]))}
    grid = draw_grid(rng, 1.6 if name in ("cddt", "lookup") else 2.7)
    poses = draw_poses(rng, grid, POSES_OF_RAYS, 0.1, 1.0)
    bearings = np.concatenate([rng.uniform(-np.pi, np.pi, BEARINGS_OF_RAYS - 8), np.arange(-4, 4) * (np.pi / 4)])
    range_max = grid.resolution * float(10 ** rng.uniform(0, 3.3))
    precision = "float32" if rng.random() < (0.9 if name == "exact" else 0.6) else "float64"
    caster = gs.RayCaster(
        grid, range_max, method=way, backend=case.device.backend, precision=precision, **policy
    )  # fmt: skip
    yield f"{name} {precision}", caster.cast(poses, bearings)
    if name in ("exact", "dda") and rng.random() < 0.3:
        yield "incidence", caster.incidence(poses, bearings)
    if rng.random() < 0.1:
        caster.update_map(np.full((1, 1), 100 * int(rng.integers(2))), (grid.shape[0] // 2, grid.shape[1] // 2))
        yield "changed", caster.cast(poses[:20], bearings)
    if rng.random() < 0.2 and case.device.there is not None:
        yield "there", caster.cast(case.device.there(poses[:20]), bearings)


ACTIONS: dict[str, Callable[[Case], Outcome]] = {
    "scan": act_scan, "several": act_several, "landmark": act_landmark, "tables": act_tables, "position": act_point,
    "heading": act_point, "beacon": act_point, "bumper": act_point,
}  # fmt: skip


# --- Models -----------------------------------------------------------------------------------------------------------


def make_scan_model(config: dict[str, Any], world: World, backend: Any, rng: np.random.Generator) -> Any:
    """Make a model of a scan."""
    options, count = dict(config["options"]), world.scanner.count
    if "bins" in config:
        options["sensor_table"] = world.scanner.range_max / config["bins"]
    if options.get("beams") == "some":
        options["beams"] = [int(i) for i in rng.permutation(count)[: max(count // 2, 1)]]
    return config["class"](world.grid, world.scanner, backend=backend, **options)


def make_models(config: dict[str, Any], world: World, backend: Any, rng: np.random.Generator) -> list[Any]:
    """Make the models of a configuration for a world."""
    kind = config["kind"]
    if kind == "scan":
        return [make_scan_model(config, world, backend, rng)]
    if kind == "several":
        return [make_scan_model(each, world, backend, rng) for each in config["members"]]
    if kind == "landmark":
        most = 40 if config["options"].get("association") == "joint" else 400
        count = 0 if rng.random() < 0.05 else int(rng.integers(1, most))
        xy, signatures = world.pose[:2] + rng.uniform(-12, 12, (count, 2)), rng.normal(3, 1, count)
        there = gs.LandmarkMap(xy, signatures if "sigma_signature" in config["parameters"] else None)
        return [gs.LandmarkModel(there, gs.LandmarkParameters(**config["parameters"]), backend=backend,
                                 **config["options"])]  # fmt: skip
    if kind == "tables":
        return []
    own, parameters, options = config["class"], config["parameters"], dict(config["options"])
    if kind == "beacon":
        return [own(world.pose[:2] + rng.uniform(-20, 20, (6, 2)), parameters, backend=backend, **options)]
    if kind == "bumper":
        return [own(world.grid, options.pop("outline"), parameters, backend=backend, **options)]
    return [own(parameters, backend=backend, **options)]


def seeds(seed: int, name: str, *numbers: int) -> np.random.Generator:
    """Return the randomness of a case or a round."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), *numbers])


# --- Results ----------------------------------------------------------------------------------------------------------


def on_host(value: Any) -> np.ndarray:
    """Copy a result to the host; every library has its way."""
    if isinstance(value, np.ndarray):
        return value
    found = value.get() if hasattr(value, "get") else value.numpy()
    return np.array(found)


def digest(label: str, value: Any) -> list[Any]:
    """Return what is kept of a result: label, how many numbers, their kind and shape, a digest, and the first few."""
    if isinstance(value, str):
        return [label, 0, "text", value]
    array = on_host(value)
    what = f"{array.dtype.str}{array.shape}".replace(" ", "")
    found = hashlib.blake2b(what.encode() + np.ascontiguousarray(array).tobytes(), digest_size=12).hexdigest()
    return [label, array.size, what, found, *(repr(each.item()) for each in array.reshape(-1)[:SHOWN])]


def outcome_of(action: Callable[[Case], Outcome], case: Case) -> list[list[Any]]:
    """Return what is kept of a case: results, and the error that ended it."""
    kept = []
    try:
        for label, value in action(case):
            kept.append(digest(label, value))
    except Exception as error:
        kept.append([f"error {type(error).__name__}", 0, "text", str(error)])
    return kept


class Record:
    """Collect the results of cases, and print the progress."""

    def __init__(self) -> None:
        self.cases: dict[str, list[list[Any]]] = {}
        self.numbers = self.rays = self.errors = 0
        self._begin = self._said = time.perf_counter()

    def add(self, name: str, kept: list[list[Any]]) -> None:
        """Keep a case, and say now and then how many there are."""
        self.cases[name] = kept
        self.numbers += sum(each[1] for each in kept)
        self.errors += sum(each[0].startswith("error") for each in kept)
        if (now := time.perf_counter()) - self._said > 15:
            self._said = now
            print(f"{now - self._begin:6.0f} s  {self.summary()}, at {name}", file=sys.stderr, flush=True)

    def summary(self) -> str:
        """Return counts in words."""
        return f"{len(self.cases)} cases, {self.rays} rays, {self.numbers} numbers, {self.errors} errors"


# --- Devices ----------------------------------------------------------------------------------------------------------


def pyopencl_device(info: Any) -> Device | None:
    """Return a user's queue on a device, whose arrays are pyopencl's; None where there is no such library."""
    try:
        import pyopencl as cl
        import pyopencl.array
    except ImportError:
        print("pyopencl is not here: no arrays on the device", file=sys.stderr)
        return None
    wanted, listed = (info.name, info.driver), [each for own in cl.get_platforms() for each in own.get_devices()]
    named = [(each.name.strip(), f"{each.platform.name.strip()} {each.driver_version.strip()}") for each in listed]
    found = [device for device, name in zip(listed, named, strict=True) if name == wanted]
    if not found:
        print(f"pyopencl does not show {info.name}: no arrays on the device", file=sys.stderr)
        return None
    queue = cl.CommandQueue(cl.Context(found[:1]))

    def there(array: np.ndarray) -> Any:
        return cl.array.to_device(queue, np.ascontiguousarray(array))

    return Device(queue, there, lambda own, new: own.set(np.ascontiguousarray(new)), info.kind == "gpu")


def warp_device(selection: str, info: Any) -> Device | None:
    """Return a device whose arrays are Warp's; None where there is no such library."""
    try:
        import warp as wp
    except ImportError:
        print("warp is not here: no arrays on the device", file=sys.stderr)
        return None
    where = info.selection.partition(":")[2]

    def there(array: np.ndarray) -> Any:
        kind = wp.float32 if array.dtype == np.float32 else wp.float64
        return wp.array(np.ascontiguousarray(array), dtype=kind, device=where)

    return Device(selection, there, lambda own, new: own.assign(np.ascontiguousarray(new)), info.kind == "gpu")


def devices_of(selection: str, as_gpu: bool) -> tuple[Device, Device, Any]:
    """Return where most cases run, where those with arrays on the device do, and the package's description of it."""
    info = gs.RayCaster(gs.OccupancyGrid([[0]]), 1.0, backend=selection).device
    there = None
    if info.backend == "opencl":
        there = pyopencl_device(info)
    elif info.backend == "warp":
        there = warp_device(selection, info)
    plain = Device(selection, None, None, info.kind == "gpu")
    if as_gpu:
        from gpusense.backends import get_backend

        for device in [plain, *([there] if there else [])]:
            device.backend = get_backend(device.backend)
            device.backend.info = dataclasses.replace(device.backend.info, kind="gpu", lanes=1)
    return plain, there or plain, info


# --- Commands ---------------------------------------------------------------------------------------------------------


def record_rays(record: Record, arguments: argparse.Namespace, devices: tuple[Device, Device]) -> None:
    """Cast rays until enough are cast."""
    each = POSES_OF_RAYS * BEARINGS_OF_RAYS
    part, parts = arguments.part
    for number in range(part, -(-arguments.rays // each), parts):
        rng = seeds(arguments.seed, "rays", number)
        device = devices[number % 4 == 3]
        case = Case(rng, device, {"huge": 1}, World(None, None, None, None), [])  # type: ignore[arg-type]
        record.rays += each
        record.add(f"rays/{number}", outcome_of(act_rays, case))


def record_models(record: Record, arguments: argparse.Namespace, devices: tuple[Device, Device]) -> None:
    """Run the cases of each configuration of this part, one after the other."""
    names, (part, parts) = configurations(), arguments.part
    share, rest = divmod(arguments.models, len(names))
    for i, (name, config) in enumerate(names.items()):
        if i % parts != part or not any(word in name for word in arguments.only):
            continue
        models: list[Any] = []
        for number in range(share + (i < rest)):
            again, within = divmod(number, ROUND)
            device = devices[again % 2 == 1 and config["there"]]
            if within == 0:
                rng, models = seeds(arguments.seed, name, again), []
                world, failure = draw_world(rng, config), []
                try:
                    models = make_models(config, world, device.backend, rng)
                except Exception as error:
                    failure = [[f"error {type(error).__name__}", 0, "text", str(error)]]
            case = Case(seeds(arguments.seed, name, again, within), device, config, world, models)
            record.add(f"{name}/{number}", failure or outcome_of(ACTIONS[config["kind"]], case))


def record_command(arguments: argparse.Namespace) -> int:
    """Record what the package computes."""
    plain, there, info = devices_of(arguments.backend, arguments.as_gpu)
    record, begin = Record(), time.perf_counter()
    np.seterr(all="ignore")
    if any(word in "rays" for word in arguments.only):
        record_rays(record, arguments, (plain, there))
    record_models(record, arguments, (plain, there))
    head = {
        "command": shlex.join(["python", *sys.argv]), "date": time.strftime("%Y-%m-%d %H:%M"),
        "package": str(Path(gs.__file__).parent), "platform": platform.platform(terse=True), "numpy": np.__version__,
        "device": f"{info.selection} {info.name}, {info.driver}, {info.lanes} lanes", "seconds":
        round(time.perf_counter() - begin), "rays": record.rays, "numbers": record.numbers, "errors": record.errors,
        "arrays_on_device": there.there is not None,
    }  # fmt: skip
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(kept)}" for name, kept in record.cases.items())
    arguments.output.write_text(f'{{"head": {json.dumps(head, indent=1)},\n"cases": {{\n{lines}\n}}}}\n')
    print(json.dumps(head, indent=1))
    kinds = sorted({each[0] + ": " + name.split("/")[0] for name, kept in record.cases.items() for each in kept
                    if each[0].startswith("error")})  # fmt: skip
    print("\n".join(kinds))
    return 0


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the head and the cases of a record."""
    found = json.loads(path.read_text())
    return found["head"], found["cases"]


def differences(old: list[list[Any]], new: list[list[Any]], messages: bool) -> Iterator[tuple[Any, Any]]:
    """Find the results of a case that differ."""
    for one, other in itertools.zip_longest(old, new):
        both = one is not None and other is not None and one[:3] == other[:3]
        texts = both and one[2] == "text" and not messages
        if not both or (one[3:] != other[3:] and not texts):
            yield one, other


def compare_command(arguments: argparse.Namespace) -> int:
    """Compare a record with another one, which may be in parts."""
    head, old = read(arguments.old)
    new: dict[str, Any] = {}
    for path in arguments.new:
        own, cases = read(path)
        new |= cases
        for key in ("platform", "numpy", "device", "arrays_on_device"):
            if own[key] != head[key]:
                print(f"note: {key} is {head[key]} in {arguments.old} and {own[key]} in {path}")
    results = numbers = bad_results = bad_numbers = 0
    told: dict[str, int] = {}
    for name in sorted(set(old) | set(new)):
        one, other = old.get(name, []), new.get(name, [])
        results += max(len(one), len(other))
        numbers += sum(each[1] for each in one)
        for before, after in differences(one, other, arguments.messages):
            bad_results += 1
            bad_numbers += max(each[1] for each in (before, after) if each)
            family = name.split("/")[0]
            told[family] = told.get(family, 0) + 1
            if told[family] <= 3:
                print(f"{name}:\n  {arguments.old}: {before}\n  new: {after}")
    for family, count in told.items():
        print(f"{family}: {count} results differ")
    missing = len(set(old) ^ set(new))
    print(f"{len(set(old) & set(new))} cases compared, {missing} only in one; {results} results of {numbers} numbers")
    print(f"{bad_results} results of {bad_numbers} numbers differ")
    return int(bool(bad_results or missing))


def part_of(text: str) -> tuple[int, int]:
    """Read which part of how many."""
    part, parts = (int(number) for number in text.split("/"))
    if not 0 <= part < parts:
        raise argparse.ArgumentTypeError(f"must be i/n with 0 <= i < n, got {text}")
    return part, parts


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    record = commands.add_parser("record", help="record what the package computes")
    record.add_argument("--backend", default="opencl", help="selection string")
    record.add_argument("--rays", type=int, default=2_000_000)
    record.add_argument("--models", type=int, default=15_000, help="cases of models")
    record.add_argument("--seed", type=int, default=0)
    record.add_argument("--part", type=part_of, default=(0, 1), metavar="I/N", help="only the I-th of N parts")
    record.add_argument("--only", nargs="+", default=[""], metavar="WORDS", help="configurations with these words")
    record.add_argument("--as-gpu", action="store_true", help="take a processor for a GPU")
    record.add_argument("--output", type=Path, required=True)
    record.set_defaults(run=record_command)
    compare = commands.add_parser("compare", help="compare two records")
    compare.add_argument("old", type=Path)
    compare.add_argument("new", type=Path, nargs="+", help="a record, or its parts")
    compare.add_argument("--messages", action="store_true", help="compare texts too: messages of errors, explain()")
    compare.set_defaults(run=compare_command)
    arguments = parser.parse_args()
    return int(arguments.run(arguments))


if __name__ == "__main__":
    sys.exit(main())
