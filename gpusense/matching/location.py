"""Results of global localisation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

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
            :data:`gpusense.matching.location_evidence.NAMES`.
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
