"""Actions of cases; each yields labels and results."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs
from trees.cases import Case, Outcome, draw_cloud, draw_count, draw_grid, draw_poses, draw_readings
from trees.configurations import knobs, learned

# Number of rays in a case of rays.
POSES_OF_RAYS, BEARINGS_OF_RAYS = 150, 44
# Particle-beams from which GPUs sort the particles.
LARGE = 1 << 22


def on_host(value: Any) -> np.ndarray:
    """Copy a result to the host, by the function of its library."""
    if isinstance(value, np.ndarray):
        return value
    found = value.get() if hasattr(value, "get") else value.numpy()
    return np.array(found)


def score(case: Case) -> Outcome:
    """Score a scan, with one of the accepted types and layouts of its arrays."""
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
    """Score a scan with ``per_beam=True``."""
    poses, ranges = draw_cloud(case, draw_count(case)), draw_readings(case.rng, case.world)
    log_p, parts = case.model.log_likelihood(poses, ranges, per_beam=True)
    yield "log_p", log_p
    yield "parts", parts


def score_scans(case: Case) -> Outcome:
    """Score several scans, each with its own particles."""
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
    """Compute expected ranges and angles of incidence."""
    poses = draw_cloud(case, draw_count(case))
    if not isinstance(case.model, gs.BeamModel):
        yield "log_p", case.model.log_likelihood(poses, draw_readings(case.rng, case.world))
        return
    yield "expected", case.model.expected_ranges(poses)
    if case.rng.random() < 0.3:
        yield "incidence", case.model.incidence(poses)


def score_large(case: Case) -> Outcome:
    """Score enough particles on a GPU for it to sort them; score fewer on slower devices."""
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
    """Call a model with arguments that it must refuse."""
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
    """Run an action of scan models."""
    action = case.rng.choice(np.array(list(SCAN_ACTIONS)), p=list(SCAN_ACTIONS.values()))
    if case.device.there is not None and case.rng.random() < 0.3:
        action = score_there
    yield action.__name__, ""
    yield from action(case)


def act_several(case: Case) -> Outcome:
    """Score by several models in one call, with a cloud and a scan that they share or with one for each."""
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
    """Score features by landmarks, with known and with unknown correspondences, and find the correspondences."""
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
    """Draw features of landmarks, false ones, and some with missing or impossible parts."""
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
    # Older trees return squared distances in cells, and lack this argument.
    squared = {"squared": True} if "squared" in inspect.signature(gs.distance_transform).parameters else {}
    yield "distances", gs.distance_transform(grid.occupied, backend=case.device.backend, **squared)
    if rng.random() < 0.5:
        yield "normals", gs.surface_normals(grid, unknown=rng.choice(kinds), outside=rng.choice(kinds))
    ranges, world = rng.uniform(-1, 12, 50), case.world
    yield "classes", gs.classify(draw_readings(rng, world), world.scanner)
    if rng.random() < 0.05:
        yield "discrete", learned().log_likelihood(ranges, np.abs(ranges))


def act_rays(case: Case) -> Outcome:
    """Cast rays by a random caster, mostly by the exact one in float32."""
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
