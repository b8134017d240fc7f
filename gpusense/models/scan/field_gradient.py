"""Gradient and information of an interpolated likelihood field for the poses of a request."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import GRADIENT_NUMBERS
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import launch
from gpusense.interface.signatures.rows import LANES
from gpusense.interface.structs import ScanBatch, Score
from gpusense.models.chunking import Piece, chunk_of, run_pieces
from gpusense.models.poses import Poses
from gpusense.models.scan.classed import ClassedScans
from gpusense.models.scan.field_pipeline import FieldPipeline
from gpusense.models.scan.pipeline import Request
from gpusense.models.scan.readings import Readings, placing_launches

# Flags of the mixture that have no meaning for the kernel.
_OTHERS = {"LOG_TABLE", "CUBES"}


class Gradients:
    """Log p, its gradient (3) and the information (9) of S scans at poses, (S N, 13) in the grid's frame.

    The scans of all calls are equal: they are classed once, and copied once if one program evaluates them.
    """

    def __init__(self, pipeline: FieldPipeline, space: Workspace) -> None:
        self._pipeline, self._space = pipeline, space
        self._groups: Sequence[tuple[Piece, ClassedScans]] | None = None
        # The piece whose readings are on the device.
        self._copied: tuple[tuple[int, int] | None, Readings | None] = None, None

    def __call__(self, request: Request) -> np.ndarray:
        pipeline = self._pipeline
        result = np.zeros((request.scans * request.per_scan, GRADIENT_NUMBERS), pipeline.real)
        if self._groups is None:
            self._groups = [group for group in pipeline.groups(request) if group[0].count]
        for particles, scans in self._groups:
            most = chunk_of(pipeline.backend, 4 * scans.most_readings, pipeline.kept_bytes())
            run_pieces(self._space, particles, most, partial(self._score, request, particles, scans, result))
        return result

    def _score(self, request: Request, particles: Piece, scans: ClassedScans, result: np.ndarray, piece: Piece) -> None:
        """Run the program of some scans of a group."""
        (first, last), ahead = piece.scans, particles.scans[0]
        scans, rows = scans.part(first - ahead, last - ahead), result[piece.begin : piece.end]
        if (value := self._pipeline.value(scans)) is not None:
            rows[:, 0] = value
            return
        part, readings = self._copied
        if readings is None or part != piece.part:
            self._copied = None, None
            readings = self._pipeline.upload(scans, self._space)
            self._copied = piece.part, readings
        self._run(request.poses, piece, readings, rows)

    def _run(self, poses: Poses, piece: Piece, readings: Readings, rows: np.ndarray) -> None:
        pipeline, space, backend = self._pipeline, self._space, self._pipeline.backend
        placed, state = pipeline.place(poses, piece.part, space)
        numbers = space.empty("gradient", GRADIENT_NUMBERS * piece.count, pipeline.real)
        resolution = pipeline.grid.resolution
        mount_x, mount_y = (value / resolution for value in pipeline.scanner.mount[:2])
        flags = (pipeline.components | readings.flags) - _OTHERS
        flags, per_scan = with_lanes_flag(backend.info.lanes, "field_gradient", flags), piece.count // readings.scans
        # The particles of a work-item's lanes belong to one scan.
        size = readings.scans * -(-per_scan // LANES) * LANES if "IN_LANES" in flags else piece.count
        gradient = launch(
            "field_gradient", flags, (size,), table=state.table, pose_cell=placed.cell, pose=placed.pose,
            pose_low=placed.low, terms=pipeline.terms, gradient=numbers, window=placed.frame.window,
            particles=piece.count, readings=readings.readings, mount_x=mount_x, mount_y=mount_y, resolution=resolution,
            score=Score(readings.constant_term, pipeline.context.temperature), batch=ScanBatch(per_scan, 0),
            **readings.arguments | readings.constants | dict(guard=pipeline.guard * readings.reach),
        )  # fmt: skip
        backend.run((*placing_launches(placed, readings.placing), gradient))
        space.download(numbers, rows)


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
