"""Make the models of a configuration."""

from __future__ import annotations

from typing import Any

import numpy as np

import gpusense as gs
from trees.cases import World


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
