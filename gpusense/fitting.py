"""Parameters of the beam model from recorded data: readings beside expected ranges, and a test on held-out readings.

Expected ranges are cast at the poses of a log, or come with the readings in a file. Readings of one scan err together,
and so do those of neighbouring scans, so that data are kept in blocks: every other block is held out, and standard
errors of what is found there are those of blocks, not of readings.
"""

from __future__ import annotations

import gzip
import io
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense import _checks
from gpusense.backends import Backend
from gpusense.compat import PEERS
from gpusense.grid import OccupancyGrid
from gpusense.logs import Scan
from gpusense.models.beam import BeamModel
from gpusense.parameters import BeamParameters
from gpusense.scanner import Reading, classes

Floats = NDArray[np.float64]

# Scans whose rays are cast at once, lines of a file that are read at once, and readings that are scored at once.
SCANS, _LINES, _BLOCK = 256, 1 << 16, 1 << 17
# A longer line is no line of numbers.
_LONGEST_LINE = 4096


@dataclass(frozen=True, eq=False)
class RangeData:
    """Readings beside the ranges that were expected.

    Attributes:
        ranges: (n,) readings of any value [m].
        expected: (n,) expected ranges [m].
        incidence: (n,) angles of incidence, NaN where nothing is hit [rad], or None.
        block: (n,) number of the block of each reading, from 0 on.
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
        """Some of the readings."""
        incidence = None if self.incidence is None else self.incidence[which]
        parts = self.ranges[which], self.expected[which], incidence, self.block[which]
        return RangeData(*parts, self.range_max, self.range_min)

    def halves(self) -> tuple[RangeData, RangeData]:
        """Blocks 0, 2, 4, ... and the others.

        Raises:
            ValueError: there is only one block.
        """
        odd = self.block % 2 == 1
        if not odd.any():
            raise ValueError("holdout: must have at least 2 blocks of readings, got 1")
        return self.chosen(~odd), self.chosen(odd)

    @property
    def kinds(self) -> NDArray[np.uint8]:
        """(n,) the class of every reading."""
        return classes(self.ranges, self.range_min, self.range_max)


def data_of_log(
    grid: OccupancyGrid,
    scans: Sequence[tuple[int, Scan]],
    *,
    backend: str | Backend = "auto",
    range_min: float = 0.0,
    block: int = 1,
    incidence: bool = False,
    step: Callable[[str], None] = lambda text: None,
) -> RangeData:
    """Readings of a log and the ranges that a map lets expect at their poses.

    Args:
        grid: The map.
        scans: Numbered scans of one scanner, each with a pose, as ``gpusense.scoring.logged_scans`` returns them.
        backend: Where rays are cast.
        range_min: Readings below this are missing [m].
        block: Scans of a block.
        incidence: Also find the angles of incidence.
        step: Called with a text before every 256 scans.
    """
    block = _checks.integer("block", block, low=1)
    model = BeamModel(grid, scans[0][1].scanner, backend=backend)
    expected, angles = [], []
    for first in range(0, len(scans), SCANS):
        step(f"casting scan {first} of {len(scans)}")
        poses = np.array([scan.pose for _, scan in scans[first : first + SCANS]], dtype=np.float64)
        expected.append(np.asarray(model.expected_ranges(poses), np.float64))
        if incidence:
            angles.append(np.asarray(model.incidence(poses), np.float64))
    count = model.scanner.count
    # What float32 gives for "nothing" is range_max, rounded.
    ahead = np.minimum(np.concatenate(expected).ravel(), model.scanner.range_max)
    ranges = np.concatenate([scan.ranges for _, scan in scans])
    blocks = np.repeat(np.arange(len(scans)) // block, count)
    angle = np.concatenate(angles).ravel() if incidence else None
    return RangeData(ranges, ahead, angle, blocks, model.scanner.range_max, range_min)


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
    """Readings and expected ranges of a file: a line each, two numbers or three with a comma between them.

    The first is the reading z, the second the expected range z*, the third the angle of incidence [rad]. A first line
    without numbers is a header; empty lines and those that begin with # are left out.

    Args:
        path: The file, plain or compressed by gzip (.gz).
        range_max: Readings of at least this are "no return" [m].
        range_min: Readings below this are missing [m].
        every: Every so many pairs, from ``offset`` on.
        offset: Number of the first pair.
        limit: At most so many pairs; None for all.
        block: Neighbouring pairs of a block.

    Raises:
        FileNotFoundError: it is missing.
        ValueError: a line breaks the format, which names it, or no pair is chosen.
    """
    file = _checks.existing_file(_checks.path("pairs", path))
    range_max = _checks.real("range_max", range_max, above=0)
    block = _checks.integer("block", block, low=1)
    parts, seen, kept, columns = [], 0, 0, 0
    for rows in _number_rows(file):
        columns = columns or rows.shape[1]
        first = max(offset - seen, 0) if seen <= offset else (offset - seen) % every
        chosen = rows[first::every]
        if limit is not None:
            chosen = chosen[: limit - kept]
        parts.append(chosen)
        seen, kept = seen + len(rows), kept + len(chosen)
        if limit is not None and kept >= limit:
            break
    if not kept:
        rule = f"must hold a pair of number {offset}, which is the first one chosen"
        raise ValueError(f"pairs: {rule}, got {seen} in {file}")
    table = np.concatenate(parts)
    incidence = table[:, 2].copy() if columns == 3 else None
    return RangeData(
        table[:, 0].copy(), table[:, 1].copy(), incidence, np.arange(len(table)) // block, range_max, range_min
    )


def _number_rows(file: Any) -> Iterator[Floats]:
    """(n, 2) or (n, 3) numbers of a file, a block of lines at a time."""
    with open(file, "rb") as raw:
        zipped = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        stream = io.BufferedReader(gzip.GzipFile(fileobj=raw)) if zipped else raw
        columns, number, header = 0, 0, True
        lines: list[tuple[int, str]] = []
        while True:
            try:
                line = stream.readline(_LONGEST_LINE + 1)
            except (OSError, EOFError) as error:
                raise ValueError(f"{file}: must be a whole gzip file, got {error}") from None
            number += 1
            if len(line) > _LONGEST_LINE:
                raise ValueError(f"{file}: line {number}: must have at most {_LONGEST_LINE} bytes, got more")
            text = line.decode("utf-8", "backslashreplace").strip().removeprefix("\ufeff")
            if text and not text.startswith("#"):
                if header and not any(_number(word) is not None for word in text.split(",")):
                    header = False
                else:
                    header = False
                    columns = columns or text.count(",") + 1
                    lines.append((number, text))
            if lines and (len(lines) == _LINES or not line):
                yield _numbers(file, lines, columns)
                lines = []
            if not line:
                return


def _numbers(file: Any, lines: list[tuple[int, str]], columns: int) -> Floats:
    """The numbers of some lines.

    Raises:
        ValueError: the first line that does not hold so many.
    """
    if columns in (2, 3) and all(text.count(",") == columns - 1 for _, text in lines):
        try:
            return np.array(",".join(text for _, text in lines).split(","), np.float64).reshape(-1, columns)
        except ValueError:
            pass
    for number, text in lines:
        words = text.split(",")
        wrong = next((word for word in words if _number(word) is None), None)
        if wrong is not None:
            raise ValueError(f"{file}: line {number}: must hold numbers, got {_checks.show(wrong.strip())}")
        if len(words) != columns or columns not in (2, 3):
            rule = f"must hold {columns} numbers" if columns in (2, 3) else "must hold 2 or 3 numbers"
            raise ValueError(f"{file}: line {number}: {rule} with commas between them, got {len(words)}")
    return np.array([[float(word) for word in text.split(",")] for _, text in lines])


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


@dataclass(frozen=True)
class HeldOut:
    """How likely held-out readings are with some parameters, beside the fitted ones.

    Attributes:
        name: Whose parameters.
        parameters: They, with weights that sum to 1.
        per_beam: Mean log-likelihood of a reading [nats]; -inf where one is impossible.
        error: Its standard error, by blocks.
        gain: Mean by which the fitted parameters make a reading likelier [nats]; 0 for the fitted ones. Where these
            make a reading impossible it is that of the softened ones.
        gain_error: Its standard error, by blocks; NaN where there are fewer than 2.
        impossible: Readings that are impossible.
    """

    name: str
    parameters: BeamParameters
    per_beam: float
    error: float
    gain: float
    gain_error: float
    impossible: int


def peer_parameters() -> dict[str, BeamParameters]:
    """Default parameters of nav2_amcl and Beluga, their weights divided by their sums, which are not 1."""
    found = {}
    for name, label in (("amcl", "nav2_amcl's defaults"), ("beluga", "Beluga's defaults")):
        values = PEERS[name].beam.to_dict()
        total = sum(values[weight] for weight in ("z_hit", "z_short", "z_max", "z_rand"))
        found[label] = BeamParameters.from_dict(
            {key: value / total if key.startswith("z_") else value for key, value in values.items()}
        )
    return found


def softened(fitted: BeamParameters, readings: int) -> BeamParameters:
    """Fitted parameters as if each cause had been seen half a time more, so that none is impossible (Jeffreys)."""
    values = fitted.to_dict()
    for name in ("z_hit", "z_short", "z_max", "z_rand"):
        values[name] = (values[name] * readings + 0.5) / (readings + 2)
    return BeamParameters.from_dict(values)


def compare_held_out(
    fitted: BeamParameters, data: RangeData, *, readings: int, range_bias: float = 0.0
) -> list[HeldOut]:
    """Held-out readings with fitted parameters, and with the defaults of nav2_amcl and Beluga.

    All are likelihoods by the book's normalised mixture, not the weights that these programs compute. Where the fitted
    parameters make a held-out reading impossible, softened ones follow them, with which the others are compared.

    Args:
        fitted: Parameters that these readings had no part in.
        data: The readings.
        readings: How many the parameters were fitted to.
        range_bias: Offset that was fitted with them, taken from the readings before they are scored [m].

    Raises:
        ValueError: every reading is missing.
    """
    known = data.kinds != Reading.MISSING
    if not known.any():
        raise ValueError("holdout: must hold out a reading that is not missing, got none")
    data = data.chosen(known)
    _, place = np.unique(data.block, return_inverse=True)
    candidates = {"fitted": fitted}
    own = log_densities(fitted, data, range_bias)
    if np.isneginf(own).any():
        candidates["fitted, softened"] = softened(fitted, readings)
        own = log_densities(candidates["fitted, softened"], data, range_bias)
    rows = []
    for name, parameters in {**candidates, **peer_parameters()}.items():
        log_p = log_densities(parameters, data, range_bias if name in candidates else 0.0)
        with np.errstate(invalid="ignore"):
            gain = np.where(own == log_p, 0.0, own - log_p)
        mean, gained = block_mean(log_p, place), block_mean(gain, place)
        rows.append(HeldOut(name, parameters, *mean, *gained, int(np.count_nonzero(np.isneginf(log_p)))))
    return rows


def log_densities(parameters: BeamParameters, data: RangeData, range_bias: float = 0.0) -> Floats:
    """(n,) log p of readings that are not missing: densities [1/m], probabilities of no return."""
    from gpusense.reference.densities import log_mixture  # loads SciPy

    z, top = data.ranges, data.range_max
    hit = data.kinds == Reading.HIT
    z = np.where(hit, np.clip(z - range_bias, 0, np.nextafter(top, 0)), top)
    found = [
        log_mixture(z[first : first + _BLOCK], data.expected[first : first + _BLOCK], range_max=top,
                    **parameters.to_dict())
        for first in range(0, len(z), _BLOCK)
    ]  # fmt: skip
    return np.concatenate([np.zeros(0), *found])


def block_mean(values: Floats, block: NDArray[np.int64]) -> tuple[float, float]:
    """Mean of all values and its standard error, that of a ratio of sums over blocks; NaN for fewer than 2 blocks."""
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


def without_missing(data: RangeData) -> RangeData:
    """The readings that say something, their ranges below range_max or infinite."""
    kept = data.chosen(data.kinds != Reading.MISSING)
    return replace(kept, ranges=np.where(kept.kinds == Reading.MAX, np.inf, kept.ranges))
