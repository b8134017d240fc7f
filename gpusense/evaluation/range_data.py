"""Read training data: readings with their expected ranges.

Expected ranges are cast at the poses of a log, or come with the readings in a file. Errors within a scan and between
neighbouring scans are correlated, so data are grouped in blocks, and every other block may be held out.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.lines import numbered_lines
from gpusense._util.typing import Floats
from gpusense.backends import Selection
from gpusense.learning.beam.incidence import IncidenceFit
from gpusense.learning.beam.pairs import impossible_ranges
from gpusense.logs import Scan
from gpusense.models.scan.beam import BeamModel
from gpusense.peers.weights import Beluga
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Reading, reading_classes

# Scans per call of the ray caster, and lines per read of a file.
SCANS, _LINES = 256, 1 << 16
# Longest line of numbers [bytes].
_LONGEST_LINE = 4096


@dataclass(frozen=True, eq=False)
class RangeData:
    """Readings with their expected ranges.

    Attributes:
        ranges: (n,) readings of any value [m].
        expected: (n,) expected ranges [m].
        incidence: (n,) angles of incidence, NaN where nothing is hit [rad], or None.
        block: (n,) index of each reading's block, from 0.
        range_max: Readings of at least this are "no return" [m].
        range_min: Readings below this are missing [m].
    """

    ranges: Floats
    expected: Floats
    incidence: Floats | None
    block: NDArray[np.int64]
    range_max: float
    range_min: float = 0.0

    def chosen(self, which: NDArray[np.bool]) -> RangeData:
        """Return the readings that a mask selects."""
        incidence = None if self.incidence is None else self.incidence[which]
        parts = self.ranges[which], self.expected[which], incidence, self.block[which]
        return RangeData(*parts, self.range_max, self.range_min)

    def halves(self) -> tuple[RangeData, RangeData]:
        """Split the data into even and odd blocks."""
        odd = self.block % 2 == 1
        if not odd.any():
            raise ValueError("holdout: must have at least 2 blocks of readings, got 1")
        return self.chosen(~odd), self.chosen(odd)

    @property
    def kinds(self) -> NDArray[np.uint8]:
        """Return (n,) the class of every reading."""
        return reading_classes(self.ranges, self.range_min, self.range_max)


def data_of_log(
    grid: OccupancyGrid,
    scans: Sequence[tuple[int, Scan]],
    *,
    backend: Selection = "auto",
    range_min: float = 0.0,
    block: int = 1,
    incidence: bool = False,
    step: Callable[[str], None] = lambda text: None,
) -> RangeData:
    """Cast the expected ranges of a log's readings at its poses; readings below ``range_min`` [m] are missing."""
    block = checks.integer("block", block, low=1)
    model = BeamModel(grid, scans[0][1].scanner, backend=backend)
    expected, angles = [], []
    for first in range(0, len(scans), SCANS):
        step(f"casting scan {first} of {len(scans)}")
        poses = np.array([scan.pose for _, scan in scans[first : first + SCANS]], dtype=np.float64)
        expected.append(np.asarray(model.expected_ranges(poses), np.float64))
        if incidence:
            angles.append(np.asarray(model.incidence(poses), np.float64))
    count = model.scanner.count
    # In float32 "no obstacle" is range_max rounded, which may exceed range_max.
    clamped = np.minimum(np.concatenate(expected).ravel(), model.scanner.range_max)
    ranges = np.concatenate([scan.ranges for _, scan in scans])
    blocks = np.repeat(np.arange(len(scans)) // block, count)
    angle = np.concatenate(angles).ravel() if incidence else None
    return RangeData(ranges, clamped, angle, blocks, model.scanner.range_max, range_min)


def data_of_pairs(
    path: str | os.PathLike[str],
    range_max: float,
    *,
    range_min: float = 0.0,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
    block: int = 100,
) -> RangeData:
    """Read pairs of readings and expected ranges from a file with two or three comma-separated numbers per line.

    The columns are the reading z, the expected range z* and, if present, the angle of incidence [rad]. A first line
    without numbers is a header. Empty lines and lines that begin with # are skipped.

    ``range_max``: Readings of at least this are "no return" [m]. ``range_min``: Readings below this are missing [m].
    ``limit``: Largest number of pairs; None for all.
    """
    file = checks.existing_file(checks.path("pairs", path))
    range_max = checks.real("range_max", range_max, above=0)
    block = checks.integer("block", block, low=1)
    table = _chosen_rows(file, every, offset, limit)
    incidence = table[:, 2].copy() if table.shape[1] == 3 else None
    data = RangeData(
        table[:, 0].copy(), table[:, 1].copy(), incidence, np.arange(len(table)) // block, range_max, range_min
    )
    outside = np.flatnonzero(impossible_ranges(data.kinds, data.expected, range_max))
    if outside.size:
        index = int(outside[0])
        rule = f"the expected range must be in [0, {range_max}] where the reading is not missing"
        raise ValueError(f"{file}: pair {offset + every * index}: {rule}, got {data.expected[index]}")
    return data


def _chosen_rows(file: Any, every: int, offset: int, limit: int | None) -> Floats:
    """Read (n, 2) or (n, 3) numbers: every ``every``-th row from ``offset``, at most ``limit`` rows."""
    last = None if limit is None else offset + every * limit
    chosen = itertools.islice(_rows(file), offset, last, every)
    parts: list[Floats] = []
    while lines := list(itertools.islice(chosen, _LINES)):
        parts.append(_numbers(file, lines, parts[0].shape[1] if parts else lines[0][1].count(",") + 1))
    if not parts:
        raise ValueError(f"pairs: must hold a pair of index {offset}, the first one chosen, got fewer pairs in {file}")
    return np.concatenate(parts)


def _rows(file: Any) -> Iterator[tuple[int, str]]:
    """Yield the numbered rows of a file, without a header, empty lines and comments."""
    header = True
    for number, line in numbered_lines(file):
        if len(line) > _LONGEST_LINE:
            raise ValueError(f"{file}: line {number}: must have at most {_LONGEST_LINE} bytes, got more")
        text = line.decode("utf-8", "backslashreplace").strip().removeprefix("\ufeff")
        if not text or text.startswith("#"):
            continue
        if not header or any(_number(word) is not None for word in text.split(",")):
            yield number, text
        header = False


def _numbers(file: Any, lines: list[tuple[int, str]], columns: int) -> Floats:
    """Parse numbered lines of ``columns`` numbers each."""
    if columns in (2, 3) and all(text.count(",") == columns - 1 for _, text in lines):
        with contextlib.suppress(ValueError):
            return np.array(",".join(text for _, text in lines).split(","), np.float64).reshape(-1, columns)
    for number, text in lines:
        words = text.split(",")
        wrong = next((word for word in words if _number(word) is None), None)
        if wrong is not None:
            raise ValueError(f"{file}: line {number}: must hold numbers, got {checks.show(wrong.strip())}")
        if len(words) != columns or columns not in (2, 3):
            rule = f"must hold {columns} numbers" if columns in (2, 3) else "must hold 2 or 3 numbers"
            raise ValueError(f"{file}: line {number}: {rule} with commas between them, got {len(words)}")
    return np.array([[float(word) for word in text.split(",")] for _, text in lines])


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


# Number of readings that are scored at once.
_BLOCK = 1 << 17


@dataclass(frozen=True)
class HeldOut:
    """Score of held-out readings with one set of parameters.

    Attributes:
        parameters: The parameters, with weights that sum to 1.
        per_beam: Mean log-likelihood of a reading [nats]; -inf if a reading is impossible.
        error: Standard error of ``per_beam``, over blocks.
        gain: Mean log-likelihood of the fitted parameters minus ``per_beam`` [nats]; 0 for the fitted ones. If the
            fitted parameters make a reading impossible, the softened ones replace them.
        gain_error: Standard error of ``gain``, over blocks; NaN for fewer than 2 blocks.
    """

    name: str
    parameters: BeamParameters | IncidenceParameters
    per_beam: float
    error: float
    gain: float
    gain_error: float
    impossible: int


def peer_parameters() -> dict[str, BeamParameters]:
    """Return the defaults of nav2_amcl (also of Beluga's node) and of Beluga's library, with weights that sum to 1."""
    parameters = {}
    for beam, label in ((Beluga.beam, "nav2_amcl's defaults"), (Beluga.library, "Beluga's defaults")):
        values = beam.to_dict()
        total = sum(values[weight] for weight in ("z_hit", "z_short", "z_max", "z_rand"))
        parameters[label] = BeamParameters.from_dict(
            {key: value / total if key.startswith("z_") else value for key, value in values.items()}
        )
    return parameters


def softened(fitted: BeamParameters, readings: int) -> BeamParameters:
    """Return the parameters with half a reading added to each cause (Jeffreys' prior), so that none is impossible."""
    values = fitted.to_dict()
    for name in ("z_hit", "z_short", "z_max", "z_rand"):
        values[name] = (values[name] * readings + 0.5) / (readings + 2)
    return BeamParameters.from_dict(values)


def compare_held_out(
    fitted: BeamParameters,
    data: RangeData,
    *,
    readings: int,
    incidence: IncidenceFit | None = None,
) -> list[HeldOut]:
    """Score held-out readings with fitted parameters and with the defaults of nav2_amcl and Beluga.

    All likelihoods use the book's normalised mixture, not the weights that these programs compute. If the fitted
    parameters make a held-out reading impossible, a row of softened parameters follows, and gains refer to it. The fit
    by angles of incidence is a further row, softened in the same way; its gain is negative if it is better.

    ``incidence``: Fit by angles of incidence, or None; ``data`` then has angles.
    """
    known = data.kinds != Reading.MISSING
    if not known.any():
        raise ValueError("holdout: must hold out a reading that is not missing, got none")
    data = data.chosen(known)
    _, place = np.unique(data.block, return_inverse=True)

    def score(name: str, parameters: Any, soften: Callable[[], Any]) -> list[tuple[str, Any, Floats]]:
        log_p = log_densities(parameters, data)
        if not np.isneginf(log_p).any():
            return [(name, parameters, log_p)]
        soft = soften()
        return [(name, parameters, log_p), (f"{name}, softened", soft, log_densities(soft, data))]

    scored = score("fitted", fitted, lambda: softened(fitted, readings))
    baseline = scored[-1][2]
    if incidence is not None:
        scored += score("fitted by incidence", incidence.parameters, lambda: _softened_bins(incidence))
    scored += [(name, peer, log_densities(peer, data)) for name, peer in peer_parameters().items()]
    return [_row(*each, baseline, place) for each in scored]


def _softened_bins(fit: IncidenceFit) -> IncidenceParameters:
    """Return the parameters of a fit by angles of incidence, each softened by its readings."""
    bins = zip(fit.parameters.parameters, fit.counts, strict=True)
    none = fit.parameters.no_surface
    other = None if none is None else softened(none, fit.no_surface_count)
    return IncidenceParameters(fit.parameters.edges, tuple(softened(each, count) for each, count in bins), other)


def _row(
    name: str,
    parameters: BeamParameters | IncidenceParameters,
    log_p: Floats,
    baseline: Floats,
    place: NDArray[np.intp],
) -> HeldOut:
    """Return the score of a set of parameters from the readings' log p, the baseline's log p, and their blocks."""
    with np.errstate(invalid="ignore"):
        gain = np.where(baseline == log_p, 0.0, baseline - log_p)
    impossible = int(np.count_nonzero(np.isneginf(log_p)))
    return HeldOut(name, parameters, *block_mean(log_p, place), *block_mean(gain, place), impossible)


def log_densities(parameters: BeamParameters | IncidenceParameters, data: RangeData) -> Floats:
    """Return (n,) log p of readings that are not missing: densities [1/m] of ranges, probabilities of no return.

    Parameters by angles of incidence: a beam that hits no surface has the parameters for such beams or, without them,
    of the first bin, as in a model.
    """
    if isinstance(parameters, IncidenceParameters):
        assert data.incidence is not None
        place = np.digitize(data.incidence, parameters.edges[1:-1])
        place[np.isnan(data.incidence)] = len(parameters.parameters)
        sets = [*parameters.parameters, parameters.no_surface or parameters.parameters[0]]
        by_bin = np.zeros(len(data.ranges))
        for number, one in enumerate(sets):
            by_bin[place == number] = log_densities(one, data.chosen(place == number))
        return by_bin
    from gpusense.models.scan.densities import log_mixture  # loads SciPy

    z, top = data.ranges, data.range_max
    hit = data.kinds == Reading.HIT
    z = np.where(hit, np.clip(z, 0, np.nextafter(top, 0)), top)
    log_p = [
        log_mixture(z[first : first + _BLOCK], data.expected[first : first + _BLOCK], range_max=top,
                    **parameters.to_dict())
        for first in range(0, len(z), _BLOCK)
    ]  # fmt: skip
    return np.concatenate([np.zeros(0), *log_p])


def block_mean(values: Floats, block: NDArray[np.int64]) -> tuple[float, float]:
    """Return the mean of all values and its standard error, as of a ratio of sums over blocks.

    The standard error is NaN for fewer than 2 blocks, or if a value is not finite.
    """
    if not np.isfinite(values).all():
        with np.errstate(invalid="ignore"):
            return float(values.sum()), math.nan
    counts, sums = np.bincount(block).astype(float), np.bincount(block, values)
    mean = float(sums.sum() / counts.sum())
    blocks = len(counts)
    if blocks < 2:
        return mean, math.nan
    off = sums - mean * counts
    return mean, float(math.sqrt(blocks / (blocks - 1) * float(off @ off)) / counts.sum())
