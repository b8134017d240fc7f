"""Hold features of scans: kinds, poses, covariances, sizes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats

KIND_TYPE = "<U9"
"""Type of names of kinds."""

KINDS = ("line", "corner", "door", "hallway", "pole", "reflector")
"""Kinds of features; reflectors need intensities."""

# Step between signatures of successive kinds; sizes are smaller.
SIGNATURE_STEP = 10.0
_LARGEST_SIZE = 9.0
# Largest component of an unobserved direction along an observed coordinate.
_PARALLEL = 1e-6


@dataclass(frozen=True, eq=False)
class Features:
    """Features of scans from :func:`gpusense.extract_features`, ordered by scan, then by kind.

    Attributes:
        kind: (F,) names: "line", "corner", "door", "hallway", "pole" or "reflector".
        scan: (F,) index of the scan.
        pose: (F, 3) x, y [m] and theta [rad, in -pi to pi] in the robot's frame. Line: midpoint and direction, with the
            scanner on its left. Corner: vertex and bisector into the free space. Door: centre and direction across,
            away from the scanner. Hallway: axis point abreast of the robot and direction within pi / 2 of the robot's.
            Pole and reflector: centre and 0.
        covariance: (F, 3, 3) of the pose; infinite for unobserved coordinates: along a line or a hallway's axis, and
            the heading of a pole or reflector.
        information: (F, 3, 3) inverse of the covariance, finite: exactly 0 along unobserved directions.
        size: (F,) length of a line [m], opening angle of a corner's free space [rad], width of a door or hallway [m],
            radius of a pole or reflector [m].
        score: (F,) quality in 0 to 1: agreement of the readings with the shape, times certainty of its position.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> corners = gs.extract_features(room, scanner, kinds="corner", backend="numpy")
        >>> np.unique(np.abs(corners.pose[:, :2]).round(3), axis=0).tolist()
        [[3.0, 2.0]]
    """

    kind: NDArray[np.str_]
    scan: NDArray[np.int64]
    pose: Floats
    covariance: Floats
    information: Floats
    size: Floats
    score: Floats

    def __len__(self) -> int:
        return len(self.scan)

    def __iter__(self) -> Iterator[Features]:
        """Iterate over single features."""
        return (self[i : i + 1] for i in range(len(self)))

    def __getitem__(self, index: slice | NDArray[np.bool] | NDArray[np.int64] | str) -> Features:
        """Return a selection of the features, by kind, mask, indices or slice."""
        chosen: slice | NDArray[Any]
        if isinstance(index, str):
            chosen = self.kind == checks.choice("kind", index, KINDS)
        elif isinstance(index, slice):
            chosen = index
        else:
            chosen = np.asarray(index)
            if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "biu"):
                raise TypeError(f"index: must be a kind, a slice, a mask or indices, got {checks.show(index)}")
            chosen = chosen if chosen.dtype.kind == "b" else chosen.astype(np.int64)
        return Features(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    def of_scan(self, scan: int) -> Features:
        """Return the features of one scan."""
        return self[self.scan == checks.integer("scan", scan, low=0)]

    def range_bearing(self, kind: str | Sequence[str] | None = None) -> Floats:
        """Return features in the form of :class:`gpusense.LandmarkModel`.

        Args:
            kind: One or several kinds; None for all. Lines and hallways are no landmarks: their poses move with the
                robot.

        Returns:
            (F, 3) range [m], bearing [rad] and signature, see :func:`signature_of`, in the robot's frame.

        Raises:
            ValueError: an unknown kind.
        """
        chosen = self if kind is None else self[np.isin(self.kind, check_kinds("kind", kind))]
        x, y = chosen.pose[:, 0], chosen.pose[:, 1]
        return np.column_stack([np.hypot(x, y), np.arctan2(y, x), chosen.signatures])

    def lines(self) -> Floats:
        """Return the lines in the form of :class:`gpusense.LineModel`; other features are omitted.

        Returns:
            (F, 7) angle of the normal away from the scanner [rad] and distance [m], positions of both ends along the
            line from the foot of the normal, positive to the left [m], variance of the angle [rad^2], covariance [rad
            m] and variance of the distance [m^2], in the robot's frame.

        Example:
            >>> import gpusense as gs, numpy as np
            >>> scanner = gs.Scanner.uniform(angle_min=-0.9, angle_increment=0.02, count=91, range_max=9.0)
            >>> wall = gs.extract_features(2 / np.cos(scanner.bearings), scanner, backend="numpy")
            >>> bool(np.allclose(wall.lines()[:, :2], (0.0, 2.0)))
            True
        """
        chosen = self[self.kind == "line"]
        angle = chosen.pose[:, 2] - 0.5 * math.pi
        c, s = np.cos(angle), np.sin(angle)
        x, y = chosen.pose[:, 0], chosen.pose[:, 1]
        middle, half = c * y - s * x, 0.5 * chosen.size
        # The offset at the foot of the normal equals the offset at the middle plus the angle times the distance
        # between them.
        across = across_lines(chosen)
        variance, both = across[:, 1, 1], across[:, 0, 1] + middle * across[:, 1, 1]
        far = across[:, 0, 0] + 2 * middle * across[:, 0, 1] + middle**2 * variance
        return np.column_stack([wrapped(angle), c * x + s * y, middle - half, middle + half, variance, both, far])

    @property
    def signatures(self) -> Floats:
        """(F,) signatures, see :func:`signature_of`."""
        return signature_of(self.kind, self.size)

    def __repr__(self) -> str:
        counts = [(int(np.count_nonzero(self.kind == name)), name) for name in KINDS]
        words = [f"{count} {name}{'s' * (count > 1)}" for count, name in counts if count]
        return f"Features({', '.join(words) or 'none'})"


def across_lines(lines: Features) -> Floats:
    """Return the (F, 2, 2) covariances of lines: offset of the middle away from the scanner, and direction."""
    rows = np.zeros((len(lines), 2, 3))
    rows[:, 0, 0], rows[:, 0, 1], rows[:, 1, 2] = np.sin(lines.pose[:, 2]), -np.cos(lines.pose[:, 2]), 1
    result = np.asarray(np.linalg.inv(rows @ lines.information @ rows.transpose(0, 2, 1)), np.float64)
    return result


def joined(parts: Sequence[Features], scans: int) -> Features:
    """Join the features of several calls, each of ``scans`` scans except the last."""
    values = {one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Features)}
    values["scan"] = np.concatenate([part.scan + scans * number for number, part in enumerate(parts)])
    return Features(**values)


def signature_of(kind: NDArray[np.str_], size: Floats) -> Floats:
    """Return the signatures (F,) of features: ten times the index of the kind in ``KINDS``, plus the size up to 9.

    ``sigma_signature`` of :class:`gpusense.LandmarkParameters` compares sizes; kinds are never confused.
    """
    place = np.zeros(len(kind))
    for number, name in enumerate(KINDS):
        place[kind == name] = number
    signature: Floats = SIGNATURE_STEP * place + np.minimum(size, _LARGEST_SIZE)
    return signature


def check_kinds(name: str, kinds: str | Sequence[str], allowed: tuple[str, ...] = KINDS) -> tuple[str, ...]:
    """Return the checked kinds as a tuple."""
    try:
        names = (kinds,) if isinstance(kinds, str) else tuple(kinds)
    except TypeError:
        raise TypeError(f"{name}: must be kinds of features, got {checks.show(kinds)}") from None
    return tuple(checks.choice(name, one, allowed) for one in names)


@dataclass
class Found:
    """Observed quantities of features of one kind."""

    scan: np.ndarray  # (F,) index of the scan
    pose: np.ndarray  # (F, 3) in the robot's frame
    observed: np.ndarray  # (F, M, 3) observed directions in x, y and theta, as orthonormal rows
    covariance: np.ndarray  # (F, M, M) covariances along the observed directions
    size: np.ndarray  # (F,) see ``Features``
    score: np.ndarray  # (F,) see ``Features``

    def only(self, rows: np.ndarray) -> Found:
        """Return some of the features."""
        return Found(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def turned_axes(angle: np.ndarray) -> np.ndarray:
    """Return the axes (F, 3, 3) of x, y and theta, turned about the vertical by angles."""
    axes = np.zeros((len(angle), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(angle)
    axes[:, 0, 1] = np.sin(angle)
    axes[:, 1, 0], axes[:, 2, 2] = -axes[:, 0, 1], 1
    return axes


def features_of(found: dict[str, Found]) -> Features:
    """Join features of several kinds, ordered by scan, then kind."""
    parts = list(found.values())
    kind = np.concatenate(
        [np.full(len(part.scan), name, KIND_TYPE) for name, part in found.items()] or [np.zeros(0, KIND_TYPE)]
    )
    scan = np.concatenate([part.scan for part in parts] or [np.zeros(0)]).astype(np.int64)
    order = np.argsort(scan, kind="stable")
    pairs = [_covariances(part) for part in parts]

    def joined(values: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape)), *values])[order]

    pose = joined([part.pose for part in parts], (3,))
    pose[:, 2] = wrapped(pose[:, 2])
    return Features(
        kind[order], scan[order], pose, joined([one for one, _ in pairs], (3, 3)),
        joined([two for _, two in pairs], (3, 3)), joined([part.size for part in parts], ()),
        joined([part.score for part in parts], ()),
    )  # fmt: skip


def _covariances(part: Found) -> tuple[np.ndarray, np.ndarray]:
    rows = part.observed
    columns = rows.transpose(0, 2, 1)
    information = columns @ np.linalg.inv(part.covariance) @ rows
    covariance = columns @ part.covariance @ rows
    kept = columns @ rows
    lost = np.eye(3) - kept
    gone = np.einsum("fii->fi", lost) > _PARALLEL
    both = gone[:, :, None] & gone[:, None, :] & (np.abs(lost) > _PARALLEL)
    return np.where(both, np.copysign(np.inf, lost), covariance), information
