"""Every public call with valid arguments, by its signature: tests replace one argument at a time."""

from __future__ import annotations

import functools
import inspect
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import gpusense as gs

_FOLDER = tempfile.TemporaryDirectory(prefix="public-calls-")
# Results, which only the package makes.
RESULTS = {
    "BeamFit", "BoundCall", "Device", "Diagnosis", "DiscreteFit", "Estimate", "FeatureMap", "Features", "FilterState",
    "IncidenceFit", "Integrity", "Judgement",
    "LandmarkFit", "Location", "MapMatch", "MotionFit", "Odometry", "PlausibilityWarning", "PointFit", "PoseLikelihood",
    "PoseMode", "PoseVerdict", "PositionFix", "Reading", "Scan", "ScanChain", "ScanMatch", "Stretch", "Weights",
}  # fmt: skip
# Methods for the package's own use, of exceptions, or that draw a picture; and those that calls() gives otherwise.
LEFT_OUT = {
    "ParticleFilter.correct", "ParticleFilter.predict",
    "bind_terms", "start_scoring", "LikelihoodFieldModel.sample",
    "PoseLikelihood.plot", "RayCaster.save_table", "OdometryMotion.sampled", "OdometryMotion.sampled_turns",
    "OmniMotion.sampled", "VelocityMotion.sampled", "ScanMatch.changed", "ScanMatch.joined", "ScanMatch.moved",
    "ScanMatch.ordered", "ScanMatch.replaced", "PoseMonitor.restore", "Shapes.counts", "Worlds.allocate",
    "Worlds.marked", "Worlds.obstacles", "Worlds.put", "Worlds.stacks", "Worlds.table", "Worlds.watch", "devices",
}  # fmt: skip
OUTLINE = [(0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3)]


class Call(NamedTuple):
    """A function, constructor or method with valid arguments.

    Attributes:
        function: Returns the callable; methods get a fresh object.
        arguments: Valid values of all parameters.
    """

    function: Callable[[], Callable[..., Any]]
    arguments: dict[str, Any]


def scene() -> SimpleNamespace:
    """Return small objects for arguments."""
    cells = np.zeros((40, 50), np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = 100
    cells[12:18, 30:34] = 100
    grid = gs.OccupancyGrid(cells, 0.1)
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.25, count=17, range_max=6.0)
    poses = np.array([(1.2, 1.1, 0.3), (1.25, 1.15, 0.35), (2.0, 2.5, 1.0)])
    ranges = gs.RayCaster(grid, 6.0, backend="numpy").cast(poses, scanner.bearings).astype(np.float64)
    rng = np.random.default_rng(1)
    beacons = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)])
    many = np.column_stack([rng.uniform(1, 3, (40, 2)), rng.uniform(-3, 3, 40)])
    field = gs.LikelihoodFieldModel(grid, scanner, backend="numpy")
    features = gs.extract_features(ranges, scanner, backend="numpy")
    return SimpleNamespace(
        grid=grid, scanner=scanner, poses=poses, ranges=ranges, scan=ranges[0], beacons=beacons, field=field, rng=rng,
        seen=seen_from(np.array([1.5, 1.0, 0.0]), beacons), many=many, many_seen=[seen_from(pose,
        beacons) for pose in many],
        likelihood=gs.pose_likelihood(field, ranges[0], resolution=0.5, headings=8), features=features,
        feature_map=gs.map_features(features, poses, least=1), scans=[
            gs.Scan(float(k), ranges[k], scanner, (0.0, 0.0, 0.0), None) for k in range(3)
        ],
    )  # fmt: skip


def seen_from(pose: np.ndarray, beacons: np.ndarray) -> np.ndarray:
    """Return ranges and bearings of beacons from a pose."""
    off = beacons - pose[:2]
    return np.column_stack([np.hypot(*off.T), np.mod(np.arctan2(off[:, 1], off[:, 0]) - pose[2] + 3, 6) - 3])


def values_by_name(s: SimpleNamespace) -> dict[str, Any]:
    """Return values that are valid wherever a parameter has the name."""
    return dict(
        backend="numpy", grid=s.grid, scanner=s.scanner, poses=s.poses, ranges=s.scan, bearings=s.scanner.bearings,
        xy=s.beacons, cells=np.zeros((2, 2), np.int8), region=(1, 1), model=s.field, models=s.field, outline=OUTLINE,
        landmarks=gs.LandmarkMap(s.beacons), lines=gs.LineMap([(0.0, 0.0, 4.0, 0.0), (4.0, 0.0, 4.0, 3.0)]),
        risk=0.5,
    )  # fmt: skip


def given_values(s: SimpleNamespace) -> dict[str, dict[str, Any]]:
    """Return the values of calls that differ from the defaults and from :func:`values_by_name`."""
    blocks, odometry = np.arange(40) // 4, np.column_stack([0.1 * np.arange(12), 0.02 * np.arange(12), np.zeros(12)])
    odometry[:, 2] = 0.05 * np.arange(12)
    place = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    info = SimpleNamespace(resolution=0.1, width=2, height=2, origin=SimpleNamespace(
        position=place, orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)))  # fmt: skip
    laser = dict(range_max=6.0, range_min=0.1, mount=(0.1, 0.0, 0.0), cone=0.1, critical_incidence=0.5)
    expected = s.rng.uniform(1, 5, 60)
    pairs = dict(ranges=expected + s.rng.normal(0, 0.05, 60), expected=expected, range_max=6.0)
    em = pairs | dict(range_min=0.1, blocks=np.arange(60) // 6, sigma_bounds=(0.01, 1.0), lambda_bounds=(0.01, 5.0),
                      max_iterations=20)  # fmt: skip
    many = dict(poses=s.many, blocks=blocks, max_iterations=20)
    noisy = np.array([seen + s.rng.normal(0, 0.05, (4, 2)) for seen in s.many_seen])
    sightings = dict(features=noisy.reshape(-1, 2), correspondence=np.tile(np.arange(4), 40))
    solver = dict(weights=np.ones(4), loss="huber", sigma=0.1)
    distances, bearings = s.seen.T.copy()
    worlds, index = np.stack([s.grid.cells] * 2), np.zeros(len(s.poses), int)
    incidence = dict(edges=(0.0, 0.5, math.pi / 2), parameters=(gs.BeamParameters(), gs.BeamParameters()))
    table = gs.DiscreteBeamModel(gs.DiscreteCauses(), 6.0, 20)
    matrix, few = np.eye(3) / 100, s.ranges[[0, 1, 0, 1]]
    folder = Path(_FOLDER.name)
    gs.write_map(s.grid, folder / "map.yaml")
    readings = " ".join(f"{z:.3f}" for z in s.scan)
    (folder / "run.log").write_text(f"FLASER {len(s.scan)} {readings} 0 0 0 0 0 0 1.0 host 1.0\n" * 3)
    s.feature_map.save(folder / "map.geojson")
    return {
        "OccupancyGrid": dict(cells=s.grid.cells, resolution=0.1),
        "OccupancyGrid.from_message": dict(message=SimpleNamespace(info=info, data=[0, 100, -1, 0])),
        "OccupancyGrid.cell_centers": dict(rows=[0, 1], cols=[1, 2]),
        "OccupancyGrid.world_to_cells": dict(xy=np.array([(0.5, 0.5)])), "Scanner": laser,
        "Scanner.uniform": dict(angle_min=-1.0, angle_increment=0.1, count=9) | laser,
        "Scanner.from_laser_scan": dict(range_max=8.0, range_min=0.1, message=dict(
            angle_min=-1.5, angle_increment=0.5, range_min=0.1, range_max=8.0, ranges=[2.0] * 7)),
        "LandmarkMap": dict(signatures=[0, 1, 2, 3]), "LineMap": dict(segments=[(0.0, 0.0, 4.0, 0.0), (4.0, 0.0, 4.0,
        3.0)]),
        "deskew_scan": dict(motion=(0.1, 0.0, 0.05)), "compose_poses": dict(first=s.poses, second=s.poses),
        "pose_difference": dict(before=s.poses, after=s.poses[::-1].copy()),
        "mean_pose": dict(weights=np.array([0.2, 0.3, 0.5])), "wrap_angle": dict(angle=np.array([0.0, 4.0, -9.0])),
        "odometry_turns": dict(before=s.poses[0], after=s.poses[1]),
        "distance_transform": dict(obstacles=s.grid.cells > 50, resolution=0.1),
        "BeamParameters": dict(range_bias=0.01, sigma_growth=0.01, hit="student"),
        "LikelihoodFieldParameters": dict(z_hit=0.8, z_max=0.1, hit="student"),
        "LandmarkParameters": dict(sigma_signature=0.1, field_of_view=6.0, signature_span=(0.0, 4.0)),
        "PositionParameters": dict(sigma=0.5, z_hit=0.9, z_rand=0.1, region=(0.0, 0.0, 5.0, 4.0), mount=(0.1, 0.0)),
        "HeadingParameters": dict(kind="von_mises", z_hit=0.9, z_rand=0.1, offset=0.01),
        "BeaconParameters": dict(bias=0.1, kind="mixture", mount=(0.1, 0.0)), "IncidenceParameters": incidence,
        "BeamModel": dict(parameters=gs.BeamParameters(), beams=5), "RayCaster": dict(range_max=6.0),
        "LikelihoodFieldModel": dict(beams=5, parameters=gs.LikelihoodFieldParameters(interpolation="bilinear")),
        "Worlds": dict(cells=worlds, resolution=0.1, origin=(0.0, 0.0, 0.0), occupied_threshold=65),
        "Shapes": dict(discs=np.ones((2, 1, 3)), boxes=np.ones((2, 1, 5)), segments=np.ones((2, 1, 4))),
        "Worlds.grid": dict(index=1), "Worlds.replace": dict(index=np.array([1]), cells=worlds[:1]),
        "Worlds.collides": dict(radius=0.2, world=index),
        "log_likelihoods": dict(models=[gs.BeamModel(s.grid, s.scanner, backend="numpy")]),
        "LandmarkModel": dict(mount=(0.1, 0.0, 0.0)), "LineModel": dict(mount=(0.1, 0.0, 0.0)),
        "LandmarkModel.associate": dict(features=s.seen),
        "LandmarkModel.log_likelihood": dict(features=s.seen, correspondence=np.arange(4)),
        "LandmarkModel.sample": dict(correspondence=np.arange(4)),
        "LineModel.sample": dict(correspondence=np.arange(2)),
        "LineModel.associate": dict(features=np.array([(1.1, 0.2), (2.0, -1.3)])),
        "LineModel.log_likelihood": dict(features=np.array([(1.1, 0.2), (2.0, -1.3)]), correspondence=np.arange(2)),
        "PositionModel": dict(parameters=gs.PositionParameters(0.5)),
        "BeaconModel": dict(parameters=gs.BeaconParameters()),
        "HeadingModel": dict(parameters=gs.HeadingParameters()), "BumperModel": dict(parameters=gs.BumperParameters()),
        "PositionModel.log_likelihood": dict(fix=(1.0, 1.0), covariance=np.eye(2)),
        "PositionModel.sample": dict(covariance=np.eye(2)), "HeadingModel.log_likelihood": dict(heading=0.3),
        "BeaconModel.log_likelihood": dict(ranges=distances, ids=np.arange(4)),
        "BeaconModel.sample": dict(ids=np.arange(4)),
        "BumperModel.log_likelihood": dict(pressed=[True]), "DiscreteBeamModel.from_dict": dict(values=table.to_dict()),
        "DiscreteBeamModel": dict(causes=gs.DiscreteCauses(), range_max=6.0, bins=20),
        "DiscreteBeamModel.log_likelihood": pairs, "DiscreteBeamModel.sensor_table": dict(dtype=np.float32),
        "DiscreteBeamModel.learn": pairs | dict(bins=6, blocks=np.arange(60) // 6),
        "ParticleFilter": dict(motion=gs.OdometryMotion(), particles=30, temperature=1.0, stages=2),
        "ParticleFilter.initialize": dict(mean=s.poses[0], covariance=matrix, particles=30),
        "ParticleFilter.initialize_uniform": dict(bounds=((0.5, 0.5), (3.0, 3.0)), particles=30),
        "ParticleFilter.initialize_from": dict(likelihood=s.likelihood, particles=30),
        "ParticleFilter.diagnose": dict(search=False), "PoseMonitor.diagnose": dict(search=False),
        "ParticleFilter.restore": dict(state=started(s).state()), "OdometryMotion": dict(systematic=(0.01, 0.0, 0.0)),
        "OdometryMotion.from_dict": dict(values={"alpha": [0.02] * 4, "reverse": 0.02}),
        "PoseMonitor.update": dict(pose=s.poses[0], covariance=matrix),
        "judge_trajectory": dict(scans=s.scans, times=np.arange(3.0), covariances=np.tile(matrix, (3, 1, 1)),
        searches=0),
        "Judgement.duration": dict(verdict="lost"),
        "integrity": dict(errors=np.array([0.1, 0.4]), radii=np.array([0.3, 0.3]), alert_limit=0.5,
        times=np.arange(2.0)),
        "normalize_weights": dict(log_p=np.array([-1.0, -2.0, -3.0])),
        "resample": dict(weights=np.array([0.2, 0.3, 0.5]), count=5, rng=0),
        "calibrate_temperature": dict(scans=np.tile(s.ranges, (2, 1)), poses=np.tile(s.poses, (2, 1))),
        "fit_odometry_motion": dict(odometry=odometry, poses=odometry + np.cumsum(s.rng.normal(0, 0.002, (12, 3)),
        axis=0)),
        "fit_beam_parameters": em, "fit_incidence_parameters": em | dict(incidence=s.rng.uniform(0, 1.2, 60), bins=2),
        "fit_position_parameters": many | dict(fixes=s.many[:, :2] + s.rng.normal(0, 0.2, (40, 2)), region=(0.0, 0.0,
        5.0, 4.0)),
        "fit_heading_parameters": many | dict(headings=s.many[:, 2] + s.rng.normal(0, 0.1, 40), kind="von_mises"),
        "fit_beacon_parameters": many | dict(ranges=noisy[..., 0]),
        "fit_bumper_parameters": many | dict(pressed=s.rng.integers(0, 2, (40, 1)).astype(bool)),
        "fit_landmark_parameters": dict(poses=s.many, scan=np.repeat(np.arange(40), 4), field_of_view=6.28,
                                        max_iterations=20) | sightings,
        "suspicious_landmarks": dict(poses=np.repeat(s.many, 4, axis=0),
        parameters=gs.LandmarkParameters()) | sightings,
        "trilaterate": dict(ranges=distances) | solver, "triangulate": dict(bearings=bearings, heading=0.0) | solver,
        "triangulate_triangle": dict(xy=s.beacons[:3], bearings=bearings[:3], sigma=0.05),
        "locate": dict(ranges=distances, bearings=bearings, sigma_range=0.1, sigma_bearing=0.05, weights=np.ones(4),
        loss="huber"),
        "match_scan": dict(reference=s.ranges[0], ranges=s.ranges[1], noise=0.03, window=(0.5, 0.2), motion=(0.01,
        0.0, 0.0),
                           reference_motion=(0.0, 0.0, 0.0)),
        "match_map": dict(local_grid=s.grid, guess=(0.0, 0.0, 0.0), window=(0.5, 0.5, 0.2), angle=0.1),
        "locate_scan": dict(resolution=0.5, angle=0.2, modes=3), "pose_likelihood": dict(resolution=0.5, headings=8),
        "PoseLikelihood.modes": dict(count=3, angle=0.3), "PoseLikelihood.poses": dict(row=[0, 1], col=[0, 1],
        heading=[0, 1]),
        "build_map": dict(scans=np.tile(s.ranges, (2, 1)), poses=np.tile(s.poses, (2, 1)), resolution=0.2,
        range_limit=5.0),
        "chain_scans": dict(scans=few, odometry=s.poses[[0, 1, 0, 1]], times=np.arange(4.0), close_loops=False),
        "extract_features": dict(ranges=s.ranges, kinds=("line",
        "corner"), noise=0.02, intensities=np.ones_like(s.ranges)),
        "map_features": dict(features=s.features, kinds=("line", "corner"), least=1),
        "landmarks_of_map": dict(kinds="line", range_max=6.0), "Features.of_scan": dict(scan=0),
        "Features.range_bearing": dict(kind="corner"), "FeatureMap.landmarks": dict(kinds="corner"),
        "read_map": dict(path=folder / "map.yaml"), "write_map": dict(path=folder / "out.yaml"),
        "read_log": dict(path=folder / "run.log", range_max=6.0), "check_mount": dict(scans=s.scans),
        "FeatureMap.save": dict(path=folder / "out.geojson"), "FeatureMap.load": dict(path=folder / "map.geojson"),
    }  # fmt: skip


def started(s: SimpleNamespace, **options: Any) -> gs.ParticleFilter:
    """Return a filter with particles around a pose."""
    pf = gs.ParticleFilter(s.field, particles=30, **options)
    pf.initialize(mean=s.poses[0], covariance=np.eye(3) / 100)
    return pf


def watching(s: SimpleNamespace) -> gs.PoseMonitor:
    """Return a monitor with the verdict of a pose."""
    monitor = gs.PoseMonitor(s.field)
    monitor.update(s.poses[0], s.scan)
    return monitor


def moved(s: SimpleNamespace, motion: Any, *names: str) -> Callable[..., np.ndarray]:
    """Return a function of named arguments that moves a filter's particles, and returns them."""
    pf = started(s, motion=motion)

    def predict(**arguments: Any) -> np.ndarray:
        pf.predict(*(arguments[name] for name in names))
        return pf.host_particles()

    return predict


def corrected(s: SimpleNamespace) -> Callable[..., Any]:
    """Return a function that corrects a filter, and returns its estimate and weights."""
    pf = started(s)

    def correct(readings: Any) -> Any:
        pf.correct(readings)
        return pf.estimate(), pf.host_weights()

    return correct


@functools.cache
def calls() -> dict[str, Call]:
    """Return the calls by name: ``trilaterate``, ``BeamModel``, ``BeamModel.log_likelihood``."""
    s, found = scene(), dict[str, Call]()
    named, given = values_by_name(s), given_values(s)
    objects: dict[str, Callable[[], Any]] = {
        "ParticleFilter": lambda: started(s), "PoseMonitor": lambda: watching(s),
        "Estimate": lambda: started(s).estimate(), "PoseVerdict": lambda: gs.PoseVerdict(0.0, "tracking", 0.9),
        "Judgement": lambda: gs.judge_trajectory(s.field, s.scans, s.poses, searches=0),
        "PoseLikelihood": lambda: s.likelihood, "Features": lambda: s.features, "FeatureMap": lambda: s.feature_map,
    }  # fmt: skip

    def completed(name: str, function: Callable[..., Any]) -> dict[str, Any]:
        """Return the value of each parameter: the call's, the value by name, or the default."""
        kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        parameters = {
            one.name: one
            for one in inspect.signature(function).parameters.values()
            if one.name != "self" and one.kind not in kinds
        }
        known = named | {key: one.default for key, one in parameters.items() if key not in named} | given.get(name, {})
        values = {key: known[key] for key in parameters}
        missing = [key for key, value in values.items() if value is inspect.Parameter.empty]
        assert not missing, f"{name}: parameters {missing} must have values"
        return values

    for name in gs.__all__:
        value = getattr(gs, name)
        if inspect.isclass(value) and name not in ("PlausibilityWarning", "Reading"):
            if name not in RESULTS:
                found[name] = Call(lambda value=value: value, completed(name, value))
                objects.setdefault(name, lambda value=value, name=name: value(**found[name].arguments))
            for each in dir(value):
                key, method = f"{name}.{each}", getattr(value, each)
                if each.startswith("_") or not callable(method) or {key, each} & LEFT_OUT:
                    continue
                if each == "from_dict" and key not in given:
                    given[key] = dict(values=objects[name]().to_dict())
                if arguments := completed(key, method):
                    found[key] = Call(lambda name=name, each=each: getattr(objects[name](), each), arguments)
                elif each == "replace":
                    found[key] = Call(lambda name=name: objects[name]().replace, found[name].arguments)
        elif callable(value) and not inspect.isclass(value) and name not in LEFT_OUT:
            found[name] = Call(lambda value=value: value, completed(name, value))
    read = found["read_log"].arguments
    return found | {
        "read_log": Call(lambda: lambda **arguments: list(gs.read_log(**arguments)), read),
        "ParticleFilter.predict": Call(
            lambda: moved(s, None, "before", "after"), dict(before=(0.0, 0.0, 0.0), after=(0.1, 0.02, 0.05))
        ),
        "ParticleFilter.predict.velocity": Call(
            lambda: moved(s, gs.VelocityMotion(), "velocity", "seconds"), dict(velocity=(0.3, 0.1), seconds=0.5)
        ),
        "ParticleFilter.correct": Call(lambda: corrected(s), dict(readings=s.scan)),
    }
