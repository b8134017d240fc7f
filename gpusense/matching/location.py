"""Results of global localisation, and the probability that a pose is right.

The probability is a product of two: the pose explains the scan, and it is the right one among poses of nearly the same
score. The latter is 1/2 where a second pose is as good. Both are logistic functions;
``bench/derive/location_evidence.py`` fitted their weights to scans of half of the recorded logs and of simulated ones,
on the maps of the same and of other places; right and wrong poses have equal weight.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gpusense._util.html import card
from gpusense._util.typing import Floats

Status = Literal["found", "ambiguous", "no match"]


@dataclass(frozen=True, eq=False)
class PoseMode:
    """A local maximum of the scores of poses.

    Attributes:
        pose: (3,) x, y and theta in the world [m, m, rad].
        score: Mean score of the end points, from 0 (all far from obstacles) to 1 (all on obstacles).
        log_likelihood: log p(z | pose, m) by the model.
        agreement: Share of the hits that agree with the expected ranges at the pose.
        through: Share of the hits that are longer than the expected ranges, as if beams passed through walls of the
            map.
        short: Share of the hits that are shorter, for example because people stand before walls.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.PoseMode(np.array([1.0, 2.0, 0.5]), score=0.98, log_likelihood=-12.5, agreement=0.9).score
        0.98
    """

    pose: Floats
    score: float
    log_likelihood: float
    agreement: float
    through: float = 0.0
    short: float = 0.0


@dataclass(frozen=True, eq=False)
class Location:
    """The result of :func:`locate_scan`.

    Attributes:
        pose: (3,) the likeliest pose: x, y and theta in the world [m, m, rad]; refined between the poses of the grid,
            or ``modes[0].pose``.
        score: Mean score of the end points at ``modes[0].pose``, from 0 to 1.
        log_likelihood: log p(z | pose, m) there, by the model.
        agreement: Share of the hits that agree with the expected ranges there.
        modes: The likeliest pose of the grid, then distinct poses that score nearly as well, by falling score.
        p_right: Probability that the pose is right: off by at most 0.5 m and 5 degrees. It assumes that scans from the
            map's place and from other places are equally frequent.
        evidence: (E,) numbers from which ``p_right`` is computed, see
            :data:`gpusense.matching.location.NAMES`.
        status: ``"found"``; ``"ambiguous"`` where other modes are as good; ``"no match"`` where no pose explains the
            scan.
        resolution: Distance between neighbouring positions of the grid of poses [m].
        angle: Angle between neighbouring headings [rad].
        poses: Number of poses of the grid.
        evaluated: Number of poses and blocks of poses that were evaluated.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> model = gs.LikelihoodFieldModel(gs.OccupancyGrid([[0, 100]]), gs.Scanner([0.0], 1.0), backend="numpy")
        >>> gs.locate_scan(model, [np.inf], angle=0.5).status
        'no match'
    """

    pose: Floats
    score: float
    log_likelihood: float
    agreement: float
    modes: tuple[PoseMode, ...] = field(repr=False)
    p_right: float
    evidence: Floats = field(repr=False)
    status: Status
    resolution: float
    angle: float
    poses: int
    evaluated: int

    def _repr_html_(self) -> str:
        rows = [("pose", *self.pose.round(3).tolist(), self.score)]
        rows += [(f"mode {k}", *mode.pose.round(3).tolist(), mode.score) for k, mode in enumerate(self.modes, 1)]
        title = f"Location: {self.status}, p_right = {self.p_right:.3g}"
        return card(title, rows, head=("", "x [m]", "y [m]", "theta [rad]", "score"))

    @property
    def found(self) -> bool:
        """Return whether a single pose explains the scan."""
        return self.status == "found"


# ---- evidence, and the probability that a pose is right

NAMES = ("miss", "through", "short", "gap", "ahead")
"""Evidence for and against a pose.

``miss``: 1 less the score. ``through``, ``short``: shares of the hits that pass through walls of the map, and that end
    before them. ``gap``: lead in score over the second mode, relative to the depth to which modes are searched;
    infinite without a second mode. ``ahead``: lead in agreement over that mode.
"""

# Constant, and weights of the logarithms of miss, through and short: whether the pose explains the scan.
_CONSTANT = -6.73
_WEIGHTS = (-0.04, -4.83, 0.34)
# Weights of gap and ahead: whether it is the right one of two modes.
_RIVAL_WEIGHTS = (1.87, 5.22)
# Offsets added before logarithms are taken.
_LEAST = (3e-3, 1e-2, 1e-2)


def location_evidence(modes: np.ndarray, scan: np.ndarray, first: np.ndarray, depth: float) -> np.ndarray:
    """Return the evidence (S, 5) on the first mode of each scan, see :data:`NAMES`.

    ``modes`` (R, 5) are numbers of :class:`PoseMode` in the order of its fields, ``scan`` (R,) their scans, ``first``
    (S,) the rows of the scans' first modes; modes are searched down to ``depth``.
    """
    lead = modes[first[scan]] - modes
    gap, ahead = lead[:, 0] / depth, lead[:, 2]
    # A mode alone leads by its agreement.
    gap[first], ahead[first] = np.inf, modes[first, 2]
    rivals = np.array([gap, ahead]).T
    strongest = np.lexsort((_rival_odds(rivals), scan))[first]
    return np.concatenate([1 - modes[first, :1], modes[first, 3:], rivals[strongest]], axis=1)


def explained_logs(evidence: np.ndarray) -> np.ndarray:
    """Return the numbers (..., 3) that the first weights multiply."""
    logs: np.ndarray = np.log(np.maximum(evidence[..., :3], 0) + _LEAST)
    return logs


def _rival_odds(gap_and_ahead: np.ndarray) -> np.ndarray:
    """Return the log odds (R,) of first modes against other modes."""
    odds: np.ndarray = (gap_and_ahead * _RIVAL_WEIGHTS).sum(axis=-1)
    return odds


def probabilities_right(evidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities (S,) that poses are right, and that they would be right without other modes."""
    alone = _logistic(_CONSTANT + (explained_logs(evidence) * _WEIGHTS).sum(axis=-1))
    return alone * _logistic(_rival_odds(evidence[..., 3:])), alone


def _logistic(x: np.ndarray) -> np.ndarray:
    result: np.ndarray = 1 / (1 + np.exp(-np.clip(x, -50.0, 50.0)))
    return result
