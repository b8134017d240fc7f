"""Gradient and information of an interpolated likelihood field for the poses of a request."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import CLIMB, GRADIENT_NUMBERS
from gpusense.interface.lanes import with_lanes_flag, with_teams_flags
from gpusense.interface.launches import Program, launch
from gpusense.interface.signatures.rows import LANES
from gpusense.interface.structs import ScanBatch, Score
from gpusense.models.chunking import Piece, run_pieces
from gpusense.models.poses import PlacedPoses, Poses
from gpusense.models.scan.classed import ClassedScans
from gpusense.models.scan.field_pipeline import FieldPipeline
from gpusense.models.scan.pipeline import Request
from gpusense.models.scan.readings import Readings, placing_launches
from gpusense.reference.field_climb import CALM, DAMPING, ENDED, START, STEPS, climb_step

# Flags of the mixture that have no meaning for the kernel.
_OTHERS = {"LOG_TABLE", "CUBES"}
# Steps of a climb at most, and how far a climb leads from its start, and a little more [m].
_MOST_STEPS, _FARTHEST = 50, 5.5
# Length and turn of a step that end a climb [m, rad], by the bytes of a number.
_SMALL = {4: 3e-4, 8: 1e-4}


class Gradients:
    """Log p, its gradient (3) and the information (9) of S scans at poses, (S N, 13) in the grid's frame."""

    def __init__(self, pipeline: FieldPipeline, space: Workspace) -> None:
        self._pipeline, self._space = pipeline, space

    def __call__(self, request: Request) -> np.ndarray:
        pipeline = self._pipeline
        result = np.zeros((request.scans * request.per_scan, GRADIENT_NUMBERS), pipeline.real)
        for particles, scans in pipeline.groups(request):
            if particles.count:
                most = pipeline.most_particles(4 * scans.most_readings, None)
                run_pieces(self._space, particles, most, partial(self._score, request, particles, scans, result))
        return result

    def _score(self, request: Request, particles: Piece, scans: ClassedScans, result: np.ndarray, piece: Piece) -> None:
        """Run the program of some scans of a group."""
        (first, last), ahead = piece.scans, particles.scans[0]
        scans, rows = scans.part(first - ahead, last - ahead), result[piece.begin : piece.end]
        if (value := self._pipeline.value(scans)) is not None:
            rows[:, 0] = value
        else:
            self._run(request.poses, piece, self._pipeline.upload(scans, self._space), rows)

    def _run(self, poses: Poses, piece: Piece, readings: Readings, rows: np.ndarray) -> None:
        """Evaluate the poses of a piece."""
        program, numbers = self._program(poses, piece, readings)
        self._pipeline.backend.run(program)
        self._space.download(numbers, rows)

    def _program(self, poses: Poses, piece: Piece, readings: Readings) -> tuple[Program, Buffer]:
        """Return the launches for the poses of a piece, and the buffer of their results."""
        placed, flags, arguments = self._arguments(poses, piece, readings)
        flags = with_lanes_flag(self._pipeline.backend.info.lanes, "field_gradient", flags)
        # The particles of a work-item's lanes belong to one scan.
        per_scan = piece.count // readings.scans
        size = readings.scans * -(-per_scan // LANES) * LANES if "IN_LANES" in flags else piece.count
        numbers = self._space.empty("gradient", GRADIENT_NUMBERS * piece.count, self._pipeline.real)
        gradient = launch(
            "field_gradient", flags, (size,), gradient=numbers, particles=piece.count, batch=ScanBatch(per_scan, 0),
            **arguments,
        )  # fmt: skip
        return (*placing_launches(placed, readings.placing), gradient), numbers

    def _arguments(
        self, poses: Poses, piece: Piece, readings: Readings
    ) -> tuple[PlacedPoses, frozenset[str], dict[str, Any]]:
        """Place the poses of a piece; also return flags and arguments of kernels that evaluate them."""
        pipeline = self._pipeline
        placed, state = pipeline.place(poses, piece.part, self._space)
        resolution = pipeline.grid.resolution
        mount_x, mount_y = (value / resolution for value in pipeline.scanner.mount[:2])
        arguments = dict(
            table=state.table, pose_cell=placed.cell, pose=placed.pose, pose_low=placed.low, terms=pipeline.terms,
            window=placed.frame.window, readings=readings.readings, mount_x=mount_x, mount_y=mount_y,
            resolution=resolution, score=Score(readings.constant_term, pipeline.context.temperature),
            **readings.arguments | readings.constants | dict(guard=pipeline.guard * readings.reach),
        )  # fmt: skip
        return placed, (pipeline.components | readings.flags) - _OTHERS, arguments


class Climbs(Gradients):
    """Climbs of S poses, each with a scan, to maxima of the likelihood; see the kernel file ``field_climb``."""

    def __init__(self, pipeline: FieldPipeline, space: Workspace, poses: np.ndarray) -> None:
        super().__init__(pipeline, space)
        small, yaw = _SMALL[pipeline.real.itemsize], pipeline.grid.origin[2]
        self._rules: dict[str, Any] = dict(most=_MOST_STEPS, small=small, yaw_cos=math.cos(yaw), yaw_sin=math.sin(yaw))
        self._end = np.zeros((len(poses), CLIMB))
        self._end[:, :3], self._end[:, START : START + 2] = poses, poses[:, :2]
        # A scan without readings has one step of length 0.
        self._end[:, DAMPING], self._end[:, STEPS], self._end[:, CALM] = 1e-3, 1, 1

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The poses (S, 3), the numbers of steps, and whether the last step was small."""
        return self._end[:, :3], self._end[:, STEPS], self._end[:, CALM] > 0

    def _run(self, poses: Poses, piece: Piece, readings: Readings, rows: np.ndarray) -> None:
        """Climb from the poses of a piece."""
        backend, space, end = self._pipeline.backend, self._space, self._end[piece.begin : piece.end]
        end[:, STEPS], end[:, CALM] = -1, 0
        pose = end[:, :3].copy()
        if not backend.info.float64:
            # The host takes the steps.
            while not end[:, ENDED].all():
                program, gradient = self._program(_moving(pose, backend), Piece(0, piece.count, 1), readings)
                backend.run(program)
                space.read(gradient, rows)
                climb_step(end, pose, rows, **self._rules)
            return
        placed, flags, arguments = self._arguments(_moving(pose, backend), Piece(0, piece.count, 1), readings)
        # A scan has the same team alone and among others.
        flags, team = with_teams_flags(
            backend.info.kind, "climb_field", flags | placed.flags, self._pipeline.scanner.count, backend.largest_group
        )
        there, given = space.upload("climb", end), placed.arguments()
        climb = launch(
            "climb_field", flags, (piece.count * team,), poses=given["poses"], climb=there, frame=given["frame"],
            pose_status=given["pose_status"], scans=piece.count, **arguments, **self._rules,
        )  # fmt: skip
        backend.run((*placing_launches(placed, readings.placing), climb))
        space.read(there, end)


def _moving(pose: np.ndarray, backend: Backend) -> Poses:
    """Return (M, 3) poses that will move."""
    poses = Poses(pose, backend, late=True)
    poses.reach = _FARTHEST
    return poses


def in_world(numbers: np.ndarray, yaw: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log p (M,), gradient (M, 3) and information (M, 3, 3) in the world from numbers in the grid's frame.

    If the frames are not rotated, the results are views of the numbers.
    """
    gradient, information = numbers[:, 1:4], numbers[:, 4:]
    if yaw:
        c, s = np.cos(yaw), np.sin(yaw)
        turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        # One product for all poses: a Kronecker product rotates the information as a vector.
        real = numbers.dtype
        gradient = (gradient @ turned.T).astype(real)
        information = (information @ np.kron(turned, turned).T).astype(real)
    return numbers[:, 0], gradient, information.reshape(-1, 3, 3)


# ---- log-likelihoods as operations that PyTorch and JAX differentiate, by the model's own gradient


class Differentiable(NamedTuple):
    """The calls of a model that an operation makes."""

    log_p: Callable[[Any], Any]  # log-likelihoods of poses
    # Log-likelihoods of poses, and their derivatives with respect to the poses; NumPy arrays.
    gradient: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    real: np.dtype  # precision of both


def is_recorded(poses: object) -> bool:
    """Return whether poses are a tensor of PyTorch whose gradients are recorded, or are being traced by JAX."""
    name = type(poses).__module__.partition(".")[0]
    if name == "torch":
        return getattr(poses, "requires_grad", False) is True
    return name == "jax" and isinstance(poses, sys.modules["jax"].core.Tracer)


def log_likelihood_of(poses: Any, ranges: object, calls: Differentiable) -> Any:
    """Return the log-likelihoods of recorded poses as an operation of their library."""
    checks.check_values("ranges", ranges)
    if type(poses).__module__.partition(".")[0] == "torch":
        return _torch_log_likelihood(sys.modules["torch"], poses, calls)
    return _jax_log_likelihood(sys.modules["jax"], poses, calls)


def _torch_log_likelihood(torch: Any, poses: Any, calls: Differentiable) -> Any:
    """Return log-likelihoods as an operation of ``torch.autograd``; its own derivatives are not recorded."""

    def forward(ctx: Any, at: Any) -> Any:
        log_p, gradient = calls.gradient(at.detach())
        ctx.save_for_backward(torch.from_numpy(gradient).to(at.device))
        return torch.from_numpy(log_p).to(at.device)

    def backward(ctx: Any, pull: Any) -> Any:
        (gradient,) = ctx.saved_tensors
        # PyTorch expects a gradient in the precision of its input.
        return (pull[..., None] * gradient).to(poses.dtype)

    if not torch.is_grad_enabled():
        return calls.log_p(poses.detach())
    methods = {
        "forward": staticmethod(forward),
        "backward": staticmethod(torch.autograd.function.once_differentiable(backward)),
    }
    operation: Any = type("LogLikelihood", (torch.autograd.Function,), methods)
    return operation.apply(poses)


def _jax_log_likelihood(jax: Any, poses: Any, calls: Differentiable) -> Any:
    """Return log-likelihoods with a rule for their derivatives; the model is called back from JAX's program."""
    if poses.ndim < 2 or poses.shape[-1] != 3:
        raise ValueError(f"poses: shape must be (N, 3) or (S, N, 3), got {checks.shape_text(poses.shape)}")
    real = jax.dtypes.canonicalize_dtype(calls.real)
    values = jax.ShapeDtypeStruct(poses.shape[:-1], real)
    slopes = jax.ShapeDtypeStruct(poses.shape, real)

    def plain(at: Any) -> np.ndarray:
        joined, split = _batches(np.asarray(at), poses.ndim)
        return split(np.asarray(calls.log_p(joined), real))

    def both(at: Any) -> tuple[np.ndarray, np.ndarray]:
        joined, split = _batches(np.asarray(at), poses.ndim)
        log_p, gradient = calls.gradient(joined)
        return split(log_p.astype(real)), split(gradient.astype(real))

    # vmap adds leading axes to the poses: one call scores all batches.
    def forward(at: Any) -> tuple[Any, Any]:
        return jax.pure_callback(both, (values, slopes), at, vmap_method="expand_dims")

    def backward(gradient: Any, pull: Any) -> tuple[Any]:
        return ((pull[..., None] * gradient).astype(poses.dtype),)

    operation = jax.custom_vjp(lambda at: jax.pure_callback(plain, values, at, vmap_method="expand_dims"))
    operation.defvjp(forward, backward)
    return operation(poses)


def _batches(poses: np.ndarray, axes: int) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Join batches of (N, 3) or (S, N, 3) poses; also return the function that splits results."""
    outer, inner = poses.shape[: poses.ndim - axes], poses.shape[poses.ndim - axes :]
    # The scans come first, the batches of a scan after them.
    flat = np.moveaxis(poses.reshape(-1, *inner), 0, axes - 2)

    def split(results: np.ndarray) -> np.ndarray:
        rest = results.shape[axes - 1 :]
        return np.moveaxis(results.reshape(*flat.shape[:-1], *rest), axes - 2, 0).reshape(*outer, *inner[:-1], *rest)

    return flat.reshape(*inner[:-2], -1, 3), split
