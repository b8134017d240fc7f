"""Every public call with valid arguments: a registry from which tests replace one argument at a time."""

from __future__ import annotations

import functools
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import gpusense as gs

BACKEND = "numpy"
_FOLDER = tempfile.TemporaryDirectory(prefix="public-calls-")


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
    ranges = gs.RayCaster(grid, 6.0, backend=BACKEND).cast(poses, scanner.bearings).astype(np.float64)
    odometry = np.column_stack([0.1 * np.arange(12), 0.02 * np.arange(12), 0.05 * np.arange(12)])
    rng = np.random.default_rng(1)
    beacons = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)])
    place = np.array([1.5, 1.0])
    off = beacons - place
    features = np.column_stack([np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])])
    expected = rng.uniform(1, 5, 60)
    return SimpleNamespace(
        grid=grid, scanner=scanner, poses=poses, ranges=ranges, scan=ranges[0], odometry=odometry, beacons=beacons,
        distances=features[:, 0].copy(), bearings=features[:, 1].copy(), features=features, expected=expected,
        readings=expected + rng.normal(0, 0.05, 60), incidence=rng.uniform(0, 1.2, 60), rng=rng,
        drive=odometry + np.cumsum(rng.normal(0, 0.002, (12, 3)), axis=0),
        many=np.column_stack([rng.uniform(1, 3, (40, 2)), rng.uniform(-3, 3, 40)]),
    )  # fmt: skip


def _filter(s: SimpleNamespace, **options: Any) -> gs.ParticleFilter:
    pf = gs.ParticleFilter(gs.LikelihoodFieldModel(s.grid, s.scanner, backend=BACKEND), particles=30, **options)
    pf.initialize(mean=s.poses[0], covariance=np.diag([0.01, 0.01, 0.01]))
    return pf


@functools.cache
def calls() -> dict[str, Call]:
    """Return the calls by name: ``trilaterate``, ``BeamModel``, ``BeamModel.log_likelihood``."""
    s = scene()
    model, field = (
        gs.BeamModel(s.grid, s.scanner, backend=BACKEND),
        gs.LikelihoodFieldModel(s.grid, s.scanner, backend=BACKEND),
    )
    found: dict[str, Call] = {}

    def add(name: str, function: Callable[[], Callable[..., Any]], /, **arguments: Any) -> None:
        found[name] = Call(function, arguments)

    def made(kind: Any, /, **arguments: Any) -> None:
        add(kind.__name__, lambda: kind, **arguments)

    _add_data(s, add, made)
    _add_models(s, add, made)
    _add_filters(s, add, made)
    _add_learning(s, add, made)
    _add_matching(s, add, made)
    _add_files(s, add)
    del model, field
    return found


def _parameters(add: Any, made: Any, made_of: Any, /, **arguments: Any) -> None:
    """Add a class of parameters and its methods."""
    made(made_of, **arguments)
    one = made_of(**arguments)
    add(f"{made_of.__name__}.from_dict", lambda: made_of.from_dict, values=one.to_dict())
    add(f"{made_of.__name__}.replace", lambda: one.replace, **arguments)


def _add_data(s: SimpleNamespace, add: Any, made: Any) -> None:
    """Add grids, scanners, maps and poses."""
    grid = lambda: gs.OccupancyGrid(s.grid.cells.copy(), 0.1)  # noqa: E731
    made(gs.OccupancyGrid, cells=s.grid.cells, resolution=0.1, origin=(0.0, 0.0, 0.0), occupied_threshold=65)
    message = SimpleNamespace(
        info=SimpleNamespace(
            resolution=0.1, width=2, height=2,
            origin=SimpleNamespace(
                position=SimpleNamespace(x=0.0, y=0.0, z=0.0), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
            ),
        ),
        data=[0, 100, -1, 0],
    )  # fmt: skip
    add("OccupancyGrid.from_message", lambda: gs.OccupancyGrid.from_message, message=message, occupied_threshold=65)
    add("OccupancyGrid.cell_centers", lambda: grid().cell_centers, rows=[0, 1], cols=[1, 2])
    add("OccupancyGrid.obstacles", lambda: grid().obstacles, unknown="free")
    add("OccupancyGrid.with_cells", lambda: grid().with_cells, cells=np.zeros((2, 2), np.int8), region=(1, 1))
    add("OccupancyGrid.world_to_cells", lambda: grid().world_to_cells, xy=np.array([(0.5, 0.5)]))
    made(gs.Scanner, bearings=s.scanner.bearings, range_max=6.0, range_min=0.1, mount=(0.1, 0.0, 0.0), cone=0.1,
         cone_rays=9, critical_incidence=0.5)  # fmt: skip
    add("Scanner.uniform", lambda: gs.Scanner.uniform, angle_min=-1.0, angle_increment=0.1, count=9, range_max=6.0,
        range_min=0.1, mount=(0.1, 0.0, 0.0), cone=0.1, cone_rays=9, critical_incidence=0.5)  # fmt: skip
    scan = dict(angle_min=-1.5, angle_increment=0.5, range_min=0.1, range_max=8.0, ranges=[2.0] * 7)
    add("Scanner.from_laser_scan", lambda: gs.Scanner.from_laser_scan, message=scan, mount=(0.0, 0.0, 0.0),
        range_max=8.0, range_min=0.1)  # fmt: skip
    made(gs.LandmarkMap, xy=s.beacons, signatures=[0, 1, 2, 3])
    made(gs.LineMap, segments=[(0.0, 0.0, 4.0, 0.0), (4.0, 0.0, 4.0, 3.0)], two_sided=True)
    add("classify", lambda: gs.classify, ranges=s.scan, scanner=s.scanner)
    add("deskew_scan", lambda: gs.deskew_scan, ranges=s.scan, scanner=s.scanner, motion=(0.1, 0.0, 0.05))
    add("compose_poses", lambda: gs.compose_poses, first=s.poses, second=s.poses)
    add("invert_poses", lambda: gs.invert_poses, poses=s.poses)
    add("pose_difference", lambda: gs.pose_difference, before=s.poses, after=s.poses[::-1].copy())
    add("mean_pose", lambda: gs.mean_pose, poses=s.poses, weights=np.array([0.2, 0.3, 0.5]))
    add("wrap_angle", lambda: gs.wrap_angle, angle=np.array([0.0, 4.0, -9.0]))
    add("odometry_turns", lambda: gs.odometry_turns, before=s.poses[0], after=s.poses[1])
    add("distance_transform", lambda: gs.distance_transform, obstacles=s.grid.cells > 50, resolution=0.1, squared=False,
        backend=BACKEND)  # fmt: skip
    add("surface_normals", lambda: gs.surface_normals, grid=s.grid, unknown="free", outside="free")


def _add_worlds(s: SimpleNamespace, add: Any, made: Any) -> None:
    """Add many worlds, and their moving shapes."""
    cells, index = np.stack([s.grid.cells] * 2), np.zeros(len(s.poses), int)
    worlds = lambda: gs.Worlds(cells, 0.1, backend=BACKEND)  # noqa: E731
    made(gs.Worlds, cells=cells, resolution=0.1, origin=(0.0, 0.0, 0.0), backend=BACKEND, occupied_threshold=65)
    made(gs.Shapes, discs=np.ones((2, 1, 3)), boxes=np.ones((2, 1, 5)), segments=np.ones((2, 1, 4)))
    add("Worlds.grid", lambda: worlds().grid, index=1)
    add("Worlds.replace", lambda: worlds().replace, index=np.array([1]), cells=cells[:1])
    add("Worlds.collides", lambda: worlds().collides, poses=s.poses, radius=0.2, world=index, ignore=None,
        unknown="free")  # fmt: skip


def _add_models(s: SimpleNamespace, add: Any, made: Any) -> None:
    """Add measurement models, the ray caster and their parameters."""
    p, plain = functools.partial(_parameters, add, made), dict(backend=BACKEND, precision="float32")
    p(gs.BeamParameters, z_hit=0.7, z_short=0.1, z_max=0.1, z_rand=0.1, sigma_hit=0.05, lambda_short=0.2,
      range_bias=0.01, sigma_growth=0.01, hit="student", hit_dof=4.0)  # fmt: skip
    p(gs.LikelihoodFieldParameters, z_hit=0.8, z_max=0.1, z_rand=0.1, sigma_hit=0.2, max_distance=2.0,
      interpolation="nearest", hit="student", hit_dof=4.0)  # fmt: skip
    p(gs.LandmarkParameters, sigma_range=0.2, sigma_bearing=0.05, sigma_signature=0.1, z_detect=0.95, z_false=0.05,
      range_max=20.0, field_of_view=6.0, signature_span=(0.0, 4.0), p_detect=0.9)  # fmt: skip
    p(gs.LineParameters, sigma_angle=0.02, sigma_distance=0.05, z_detect=0.9, z_false=0.1, range_max=20.0, p_detect=0.9)
    p(gs.PositionParameters, sigma=0.5, covariance=None, z_hit=0.9, z_rand=0.1, region=(0.0, 0.0, 5.0, 4.0),
      mount=(0.1, 0.0))  # fmt: skip
    p(gs.HeadingParameters, sigma=0.1, kappa=100.0, kind="von_mises", z_hit=0.9, z_rand=0.1, offset=0.01)
    p(gs.BeaconParameters, sigma_range=0.3, bias=0.1, kind="mixture", nu=4, heavy_weight=0.1, sigma_heavy=1.5,
      z_hit=0.95, z_rand=0.05, range_max=100.0, mount=(0.1, 0.0))  # fmt: skip
    p(gs.BumperParameters, p_contact=0.95, p_false=0.01, sigma=0.05)
    p(gs.DiscreteCauses, lambda_short=0.05, lambda_rand=0.01, p_detect=0.95, sigma_hit=0.05)
    made(gs.IncidenceParameters, edges=(0.0, 0.5, math.pi / 2), parameters=(gs.BeamParameters(), gs.BeamParameters()),
         no_surface=None)  # fmt: skip
    incidence = gs.IncidenceParameters((0.0, 0.5, math.pi / 2), (gs.BeamParameters(), gs.BeamParameters()))
    add("IncidenceParameters.from_dict", lambda: gs.IncidenceParameters.from_dict, values=incidence.to_dict())
    made(gs.BeamModel, grid=s.grid, scanner=s.scanner, parameters=gs.BeamParameters(), incidence=None, caster="exact",
         sensor_table=None, unknown="free", outside="free", temperature=1.0, beams=5, compat=None, specialize=True,
         **plain)  # fmt: skip
    made(gs.LikelihoodFieldModel, grid=s.grid, scanner=s.scanner, parameters=None, unknown="free", outside="free",
         temperature=1.0, beams=5, compat=None, specialize=True, **plain)  # fmt: skip
    for kind in (gs.BeamModel, gs.LikelihoodFieldModel):
        make = functools.partial(_method, kind, (s.grid, s.scanner))
        name, drawn = kind.__name__, dict(seed=0, step=0, out=None)
        score, worlds = dict(poses=s.poses, ranges=s.scan), dict(world=None, ignore=None)
        add(f"{name}.log_likelihood", make("log_likelihood"), **score, **worlds, per_beam=False, out=None)
        add(f"{name}.bind", make("bind"), **score, **worlds, out=None)
        add(f"{name}.explain", make("explain"), measure=False)
        add(f"{name}.plan", make("plan"), measure=False)
        add(f"{name}.prepare", make("prepare"), poses=s.poses)
        add(f"{name}.update_map", make("update_map"), cells=np.zeros((2, 2), np.int8), region=(1, 1))
        if kind is gs.BeamModel:
            for method in ("expected_ranges", "incidence"):
                add(f"{name}.{method}", make(method), poses=s.poses, **worlds, out=None)
            add(f"{name}.sample", make("sample"), poses=s.poses, **worlds, **drawn)
        else:
            add(
                f"{name}.gradient",
                _method(kind, (s.grid, s.scanner, gs.LikelihoodFieldParameters(interpolation="bilinear")), "gradient"),
                **score,
            )
    made(gs.RayCaster, grid=s.grid, range_max=6.0, caster="exact", method=None, unknown="free", outside="free", **plain)
    cast = functools.partial(_method, gs.RayCaster, (s.grid, 6.0))
    for method in ("bind", "cast", "incidence"):
        add(f"RayCaster.{method}", cast(method), poses=s.poses, bearings=s.scanner.bearings, world=None, ignore=None,
            out=None)  # fmt: skip
    _add_worlds(s, add, made)
    add("RayCaster.prepare", cast("prepare"), poses=s.poses)
    add("RayCaster.update_map", cast("update_map"), cells=np.zeros((2, 2), np.int8), region=(1, 1))
    add("log_likelihoods", lambda: gs.log_likelihoods, models=[gs.BeamModel(s.grid, s.scanner, backend=BACKEND)],
        poses=s.poses, ranges=s.scan, out=None)  # fmt: skip
    _add_landmark_models(s, add, made, plain)
    _add_point_models(s, add, made, plain)
    made(gs.DiscreteBeamModel, causes=gs.DiscreteCauses(), range_max=6.0, bins=20, fit=None)
    table = gs.DiscreteBeamModel(gs.DiscreteCauses(), 6.0, 20)
    add("DiscreteBeamModel.log_likelihood", lambda: table.log_likelihood, ranges=s.readings, expected=s.expected)
    add("DiscreteBeamModel.sensor_table", lambda: table.sensor_table, dtype=np.float32)
    add("DiscreteBeamModel.from_dict", lambda: gs.DiscreteBeamModel.from_dict, values=table.to_dict())
    add("DiscreteBeamModel.learn", lambda: gs.DiscreteBeamModel.learn, ranges=s.readings, expected=s.expected,
        range_max=6.0, bins=6, blocks=np.arange(60) // 6)  # fmt: skip


def _method(kind: Any, arguments: tuple[Any, ...], name: str) -> Callable[[], Callable[..., Any]]:
    return lambda: getattr(kind(*arguments, backend=BACKEND), name)


def _add_landmark_models(s: SimpleNamespace, add: Any, made: Any, plain: dict[str, str]) -> None:
    landmarks, lines = gs.LandmarkMap(s.beacons), gs.LineMap([(0.0, 0.0, 4.0, 0.0), (4.0, 0.0, 4.0, 3.0)])
    made(gs.LandmarkModel, landmarks=landmarks, parameters=None, association="nearest", negative=False,
         mount=(0.1, 0.0, 0.0), temperature=1.0, specialize=True, **plain)  # fmt: skip
    made(gs.LineModel, lines=lines, parameters=None, association="nearest", mount=(0.1, 0.0, 0.0), temperature=1.0,
         specialize=True, **plain)  # fmt: skip
    seen = np.array([(1.1, 0.2), (2.0, -1.3)])
    for kind, first, features in ((gs.LandmarkModel, landmarks, s.features), (gs.LineModel, lines, seen)):
        make = functools.partial(_method, kind, (first,))
        known = np.arange(len(features))
        add(f"{kind.__name__}.associate", make("associate"), poses=s.poses, features=features)
        add(f"{kind.__name__}.log_likelihood", make("log_likelihood"), poses=s.poses, features=features,
            correspondence=known, out=None)  # fmt: skip
        add(f"{kind.__name__}.sample", make("sample"), poses=s.poses, seed=0, step=0, correspondence=known)


def _add_point_models(s: SimpleNamespace, add: Any, made: Any, plain: dict[str, str]) -> None:
    outline = [(0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3)]
    position = gs.PositionParameters(0.5)
    made(gs.PositionModel, parameters=position, temperature=1.0, **plain)
    made(gs.HeadingModel, parameters=gs.HeadingParameters(), temperature=1.0, **plain)
    made(gs.BeaconModel, xy=s.beacons, parameters=gs.BeaconParameters(), temperature=1.0, **plain)
    made(gs.BumperModel, grid=s.grid, outline=outline, parameters=gs.BumperParameters(), segments=None, unknown="free",
         outside="free", temperature=1.0, **plain)  # fmt: skip
    rows: Any = (
        (gs.PositionModel, (position,), dict(fix=(1.0, 1.0), covariance=np.eye(2)), dict(covariance=np.eye(2))),
        (gs.HeadingModel, (), dict(heading=0.3), {}),
        (gs.BeaconModel, (s.beacons,), dict(ranges=s.distances, ids=np.arange(4)), dict(ids=np.arange(4))),
        (gs.BumperModel, (s.grid, outline), dict(pressed=[True]), {}),
    )
    for kind, arguments, reading, drawn in rows:
        make = functools.partial(_method, kind, arguments)
        add(f"{kind.__name__}.log_likelihood", make("log_likelihood"), poses=s.poses, **reading, out=None)
        add(f"{kind.__name__}.sample", make("sample"), poses=s.poses, seed=0, step=0, **drawn)


def _add_filters(s: SimpleNamespace, add: Any, made: Any) -> None:
    """Add filters, motions and weights."""
    field = gs.LikelihoodFieldModel(s.grid, s.scanner, backend=BACKEND)
    made(gs.ParticleFilter, models=field, motion=gs.OdometryMotion(), particles=30, seed=0, temperature=1.0,
         resampling="systematic", threshold=0.5, stages=2, recovery="sensor", beam_skip=None)  # fmt: skip
    method = lambda name: lambda: getattr(_filter(s), name)  # noqa: E731
    add("ParticleFilter.initialize", method("initialize"), mean=s.poses[0], covariance=np.eye(3) / 100, particles=30)
    add(
        "ParticleFilter.initialize_uniform", method("initialize_uniform"), bounds=((0.5, 0.5), (3.0, 3.0)), particles=30
    )
    likelihood = gs.pose_likelihood(field, s.scan, resolution=0.5, headings=8)
    add("ParticleFilter.initialize_from", method("initialize_from"), likelihood=likelihood, particles=30)
    add("ParticleFilter.predict", lambda: _predict(s), before=s.odometry[0], after=s.odometry[1])
    add("ParticleFilter.predict.velocity", lambda: _velocity(s), velocity=(0.3, 0.1), seconds=0.5)
    add("ParticleFilter.correct", lambda: _correct(s), readings=s.scan)
    add("ParticleFilter.estimate", method("estimate"), method="mean")
    add("Estimate.protection_level", lambda: _filter(s).estimate().protection_level, risk=0.5)
    add("ParticleFilter.diagnose", method("diagnose"), search=False)
    add("ParticleFilter.restore", method("restore"), state=_filter(s).state())
    made(gs.OdometryMotion, alpha=(0.02, 0.02, 0.02, 0.02), reverse=0.02, least=(0.01, 0.005),
         systematic=(0.01, 0.0, 0.0), sideways=0.02)  # fmt: skip
    add("OdometryMotion.from_dict", lambda: gs.OdometryMotion.from_dict, values={"alpha": [0.02] * 4, "reverse": 0.02})
    made(gs.OmniMotion, alpha=(0.02,) * 5, least=(0.01, 0.005))
    made(gs.VelocityMotion, alpha=(0.02,) * 6, least=(0.01, 0.005))
    made(gs.PoseMonitor, models=field, seed=0)
    add("PoseMonitor.update", lambda: gs.PoseMonitor(field).update, pose=s.poses[0], ranges=s.scan,
        covariance=np.eye(3) / 100)  # fmt: skip
    add("PoseVerdict.protection_level", lambda: gs.PoseVerdict(0.0, "tracking", 0.9).protection_level, risk=0.5)
    add("PoseMonitor.diagnose", lambda: _monitor(field, s).diagnose, search=False)
    add("judge_trajectory", lambda: gs.judge_trajectory, models=field, scans=_scans(s), poses=s.poses,
        times=np.arange(3.0), covariances=np.tile(np.eye(3) / 100, (3, 1, 1)), risk=0.1, searches=0)  # fmt: skip
    add(
        "Judgement.duration",
        lambda: gs.judge_trajectory(field, _scans(s), s.poses, searches=0).duration,
        verdict="lost",
    )
    add("integrity", lambda: gs.integrity, errors=np.array([0.1, 0.4]), radii=np.array([0.3, 0.3]), alert_limit=0.5,
        times=np.arange(2.0))  # fmt: skip
    add("normalize_weights", lambda: gs.normalize_weights, log_p=np.array([-1.0, -2.0, -3.0]))
    add("resample", lambda: gs.resample, weights=np.array([0.2, 0.3, 0.5]), count=5, rng=0, method="systematic")
    add("calibrate_temperature", lambda: gs.calibrate_temperature, model=field, scans=np.tile(s.ranges, (2, 1)),
        poses=np.tile(s.poses, (2, 1)))  # fmt: skip
    add("fit_odometry_motion", lambda: gs.fit_odometry_motion, odometry=s.odometry, poses=s.drive, systematic=True)


def _monitor(field: Any, s: SimpleNamespace) -> gs.PoseMonitor:
    monitor = gs.PoseMonitor(field)
    monitor.update(s.poses[0], s.scan)
    return monitor


def _scans(s: SimpleNamespace) -> list[gs.Scan]:
    return [gs.Scan(float(k), s.ranges[k], s.scanner, (0.0, 0.0, 0.0), None) for k in range(3)]


def _predict(s: SimpleNamespace) -> Callable[..., Any]:
    pf = _filter(s)

    def predict(before: Any, after: Any) -> np.ndarray:
        pf.predict(before, after)
        return pf.host_particles()

    return predict


def _velocity(s: SimpleNamespace) -> Callable[..., Any]:
    pf = _filter(s, motion=gs.VelocityMotion())

    def predict(velocity: Any, seconds: Any) -> np.ndarray:
        pf.predict(velocity, seconds)
        return pf.host_particles()

    return predict


def _correct(s: SimpleNamespace) -> Callable[..., Any]:
    pf = _filter(s)

    def correct(readings: Any) -> Any:
        pf.correct(readings)
        return pf.estimate(), pf.host_weights()

    return correct


def _add_learning(s: SimpleNamespace, add: Any, made: Any) -> None:
    """Add fits of parameters, and positions from beacons."""
    search, blocks = dict(max_iterations=20, tolerance=1e-8), np.arange(40) // 4
    em = dict(method="em", range_min=0.1, initial=None, backend=BACKEND, precision=None, restarts=0, seed=0,
              range_bias=False, hit="normal", blocks=np.arange(60) // 6, sigma_bounds=(0.01, 1.0),
              lambda_bounds=(0.01, 5.0), progress=False, callback=None, **search)  # fmt: skip
    pairs = dict(ranges=s.readings, expected=s.expected)
    add("fit_beam_parameters", lambda: gs.fit_beam_parameters, **pairs, range_max=6.0, sigma_growth=False,
        responsibilities=False, **em)  # fmt: skip
    add("fit_incidence_parameters", lambda: gs.fit_incidence_parameters, **pairs, incidence=s.incidence, range_max=6.0,
        bins=2, strength=30.0, **em)  # fmt: skip
    fixes = s.many[:, :2] + s.rng.normal(0, 0.2, (40, 2))
    add("fit_position_parameters", lambda: gs.fit_position_parameters, poses=s.many, fixes=fixes, correlated=False,
        region=(0.0, 0.0, 5.0, 4.0), mount=(0.0, 0.0), fit_mount=False, blocks=blocks, **search)  # fmt: skip
    add("fit_heading_parameters", lambda: gs.fit_heading_parameters, poses=s.many,
        headings=s.many[:, 2] + s.rng.normal(0, 0.1, 40), kind="von_mises", blocks=blocks, **search)  # fmt: skip
    distances = np.hypot(*(s.many[:, None, :2] - s.beacons).transpose(2, 0, 1)) + s.rng.normal(0, 0.2, (40, 4))
    add("fit_beacon_parameters", lambda: gs.fit_beacon_parameters, poses=s.many, ranges=distances, xy=s.beacons,
        ids=None, range_max=100.0, kind="normal", nu=4, bias="common", mount=(0.0, 0.0), blocks=blocks,
        **search)  # fmt: skip
    outline = [(0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3)]
    add("fit_bumper_parameters", lambda: gs.fit_bumper_parameters, poses=s.many,
        pressed=s.rng.integers(0, 2, (40, 1)).astype(bool), grid=s.grid, outline=outline, segments=None, unknown="free",
        outside="free", blocks=blocks, backend=BACKEND, **search)  # fmt: skip
    seen = [_seen(pose, s.beacons) + s.rng.normal(0, 0.05, (4, 2)) for pose in s.many]
    landmarks, known = gs.LandmarkMap(s.beacons), np.tile(np.arange(4), 40)
    scans = np.repeat(np.arange(40), 4)
    add("fit_landmark_parameters", lambda: gs.fit_landmark_parameters, poses=s.many, features=np.concatenate(seen),
        landmarks=landmarks, correspondence=known, scan=scans, range_max=20.0, field_of_view=6.28, signature_span=None,
        mount=(0.0, 0.0, 0.0), bias=False, initial=None, **search)  # fmt: skip
    add("suspicious_landmarks", lambda: gs.suspicious_landmarks, poses=s.many[scans], features=np.concatenate(seen),
        landmarks=landmarks, correspondence=known, parameters=gs.LandmarkParameters(),
        mount=(0.0, 0.0, 0.0))  # fmt: skip
    solver = dict(weights=np.ones(4), loss="huber", loss_scale=1.0)
    add("trilaterate", lambda: gs.trilaterate, xy=s.beacons, ranges=s.distances, sigma=0.1, **solver)
    add("triangulate", lambda: gs.triangulate, xy=s.beacons, bearings=s.bearings, heading=0.0, sigma=0.05, **solver)
    add("triangulate_triangle", lambda: gs.triangulate_triangle, xy=s.beacons[:3], bearings=s.bearings[:3], sigma=0.05)
    add("locate", lambda: gs.locate, xy=s.beacons, ranges=s.distances, bearings=s.bearings, heading=None,
        sigma_range=0.1, sigma_bearing=0.05, weights=np.ones(4), loss="huber", loss_scale=1.0)  # fmt: skip


def _seen(pose: np.ndarray, beacons: np.ndarray) -> np.ndarray:
    """Return ranges and bearings of beacons from a pose."""
    off = beacons - pose[:2]
    return np.column_stack([np.hypot(*off.T), np.mod(np.arctan2(off[:, 1], off[:, 0]) - pose[2] + 3, 6) - 3])


def _add_matching(s: SimpleNamespace, add: Any, made: Any) -> None:
    """Add matches of scans and maps, chains and features."""
    field = gs.LikelihoodFieldModel(s.grid, s.scanner, backend=BACKEND)
    add("match_scan", lambda: gs.match_scan, reference=s.ranges[0], ranges=s.ranges[1], scanner=s.scanner,
        guess=(0.0, 0.0, 0.0), method="auto", backend=BACKEND, precision="float32", noise=0.03, capture=1.0,
        window=(0.5, 0.2), temperature=1.0, motion=(0.01, 0.0, 0.0), reference_motion=(0.0, 0.0, 0.0))  # fmt: skip
    add("match_map", lambda: gs.match_map, local_grid=s.grid, grid=s.grid, guess=(0.0, 0.0, 0.0),
        window=(0.5, 0.5, 0.2), angle=0.1, min_correlation=0.4, backend=BACKEND)  # fmt: skip
    add("locate_scan", lambda: gs.locate_scan, model=field, ranges=s.scan, resolution=0.5, angle=0.2, positions="free",
        modes=3, min_probability=0.7, refine=True)  # fmt: skip
    add("pose_likelihood", lambda: gs.pose_likelihood, model=field, ranges=s.scan, resolution=0.5, headings=8,
        positions="all")  # fmt: skip
    likelihood = gs.pose_likelihood(field, s.scan, resolution=0.5, headings=8)
    add("PoseLikelihood.modes", lambda: likelihood.modes, count=3, radius=0.5, angle=0.3)
    add("PoseLikelihood.poses", lambda: likelihood.poses, row=[0, 1], col=[0, 1], heading=[0, 1])
    scans = np.tile(s.ranges, (2, 1))
    poses = np.tile(s.poses, (2, 1))
    add("build_map", lambda: gs.build_map, scans=scans, poses=poses, scanner=s.scanner, sensor=None, resolution=0.2,
        origin=None, shape=None, range_limit=5.0, clear_max=False, p_hit=0.85, p_miss=0.45, p_prior=0.5,
        occupied_threshold=65, motion=None, backend=BACKEND)  # fmt: skip
    few = s.ranges[[0, 1, 0, 1]]
    add("chain_scans", lambda: gs.chain_scans, scans=few, scanner=s.scanner, odometry=s.poses[[0, 1, 0, 1]],
        sensor=None, times=np.arange(4.0), duration=0.0, motion=None, step=(0.02, 0.01),
        close_loops=False, precision="float32", backend=BACKEND)  # fmt: skip
    add("extract_features", lambda: gs.extract_features, ranges=s.ranges, scanner=s.scanner, kinds=("line", "corner"),
        backend=BACKEND, noise=0.02, intensities=np.ones_like(s.ranges))  # fmt: skip
    features = gs.extract_features(s.ranges, s.scanner, backend=BACKEND)
    add("map_features", lambda: gs.map_features, features=features, poses=s.poses, kinds=("line", "corner"),
        pose_deviation=(0.03, 0.01), least=1)  # fmt: skip
    add("landmarks_of_map", lambda: gs.landmarks_of_map, grid=s.grid, kinds="line", range_max=6.0,
        backend=BACKEND)  # fmt: skip
    add("Features.of_scan", lambda: features.of_scan, scan=0)
    add("Features.range_bearing", lambda: features.range_bearing, kind="corner")
    mapped = gs.map_features(features, s.poses, least=1)
    add("FeatureMap.landmarks", lambda: mapped.landmarks, kinds="corner")


def _add_files(s: SimpleNamespace, add: Any) -> None:
    """Add calls that read and write files in a temporary folder of the process."""
    folder = Path(_FOLDER.name)
    gs.write_map(s.grid, folder / "map.yaml")
    readings = " ".join(f"{z:.3f}" for z in s.scan)
    (folder / "run.log").write_text(f"FLASER {len(s.scan)} {readings} 0 0 0 0 0 0 1.0 host 1.0\n" * 3)
    features = gs.map_features(gs.extract_features(s.ranges, s.scanner, backend=BACKEND), s.poses, least=1)
    features.save(folder / "map.geojson")
    add("read_map", lambda: gs.read_map, path=folder / "map.yaml", occupied_threshold=65)
    add("write_map", lambda: gs.write_map, grid=s.grid, path=folder / "out.yaml", image_format="pgm", mode=None)
    add("read_log", lambda: _read_all, path=folder / "run.log", range_max=6.0, odometry=False, rear=False,
        range_min=None, topic=None, frame=None, odometry_from=None,
        mount=None)  # fmt: skip
    scans = list(gs.read_log(folder / "run.log", range_max=6.0))
    add("check_mount", lambda: gs.check_mount, scans=scans)
    add("FeatureMap.save", lambda: features.save, path=folder / "out.geojson")
    add("FeatureMap.load", lambda: gs.FeatureMap.load, path=folder / "map.geojson")


def _read_all(**arguments: Any) -> list[Any]:
    return list(gs.read_log(**arguments))
