"""List the configurations of models, by name."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

import gpusense as gs
from trees.cases import World

try:
    from gpusense import casters
except ImportError:
    casters = None  # type: ignore[assignment]

Kinds = dict[str, dict[str, Any]]

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


def knobs(name: str, **values: Any) -> Any:
    """Return a caster with these knobs, or its name in versions without knobs."""
    return name.lower() if casters is None else getattr(casters, name)(**values)


@functools.cache
def learned() -> Any:
    """Learn a discrete model from a small simulated data set."""
    rng = np.random.default_rng(5)
    expected = rng.uniform(0.2, 12.0, 4000)
    ranges = expected + 0.1 * rng.standard_normal(4000)
    ranges = np.where(rng.random(4000) < 0.15, rng.exponential(4.0, 4000), ranges)
    return gs.DiscreteBeamModel.learn(np.where(rng.random(4000) < 0.05, np.inf, ranges), expected, 10.0, bins=60)


def beam(name: str = "book", scanner: dict[str, Any] | None = None, **options: Any) -> dict[str, Any]:
    """Return a configuration of a beam model: its options, with settings of the world and the scanner."""
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
    """Return beam models with each caster, and with both policies for unknown and outside cells."""
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
    """Return beam models with tables, peers' weights, a choice of beams, and without specialisation."""
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
    """Return beam models with cones, mirrors, and parameters by angle of incidence."""
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
    """Return every configuration of models by name.

    Every fourth has huge headings, and every third also runs on a queue of the user.
    """
    found = beam_mixtures() | beam_casters() | beam_options() | beam_echoes() | fields() | severals() | landmarks()
    found |= points() | {"tables": {"kind": "tables"}}
    for i, config in enumerate(found.values()):
        config["huge"], config["there"] = i % 4 == 3, i % 3 == 2
    return found


def make_scan_model(config: dict[str, Any], world: World, backend: Any, rng: np.random.Generator) -> Any:
    """Make a scan model."""
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
