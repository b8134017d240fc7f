"""Match a single pair of scans: the device makes noise, points and lines of their readings, and starts from the guess.

NumPy takes 0.1 ms for the noise and the points of two scans of any size, a third of a match.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import MATCH_RESULT
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Program, launch
from gpusense.matching.icp import WIDTH, PlacedPairs, line_rules, slack_of, space_of
from gpusense.matching.icp_with_search import POOR, POOR_TURN, finished, judged_pairs, to_sensor
from gpusense.matching.options import COARSE_POINTS, Levels, MatchOptions
from gpusense.matching.points import NoiseLevels, beams_by_angle, beams_in_order, neighbors, noise_levels
from gpusense.matching.result import ScanMatch
from gpusense.world.scanner import Scanner, range_limits

_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
_PAIR = np.array([[0, 1, 0]], np.int32)
# Least number of beams that have neighbours on both sides, and numbers that kernels compare at once.
_LEAST_BEAMS, _AT_ONCE = 3, 8


class _Scene(NamedTuple):
    """Everything on which the program of a match depends, but its readings and its guess."""

    scanner: Scanner  # the scanner
    real: np.dtype  # precision
    kind: np.dtype  # type of the readings, to which the scanner's limits are rounded
    capture: float  # farthest distance between paired points at the start [m]
    noise: float | None  # standard deviation of ranges [m]; None where the scans tell it
    turns: int  # 2 where a match from a poor guess is repeated from its result, otherwise 1

    def levels(self) -> NoiseLevels:
        """Return the levels of noise."""
        return noise_levels() if self.noise is None else NoiseLevels(np.array([self.noise]), np.array([math.inf]), 0)


def supports_single_pair(backend: Backend, scanner: Scanner) -> bool:
    """Return whether a device matches the scans of a scanner as a single pair."""
    return (
        backend.info.kind == "cpu"
        and backend.info.float64
        and scanner.count >= _LEAST_BEAMS
        and beams_in_order(scanner)
    )


def match_pair(
    backend: Backend, real: np.dtype, first: np.ndarray, second: np.ndarray, scanner: Scanner, guess: np.ndarray,
    method: str, options: MatchOptions, *, given: bool,
) -> ScanMatch:  # fmt: skip
    """Match two scans (K,) from a guess (1, 3); ``given``: the options set the noise. ``judged`` adds ``p_right``."""
    mount = scanner.mount[:2]
    sensor = to_sensor(guess, mount)
    kind = first.dtype if first.dtype == second.dtype else np.result_type(first, second)
    turns = 2 if method == "auto" else 1
    scene = _Scene(scanner, real, kind, options.capture, options.noise if given else None, turns)
    readings, padded = np.empty((2, scanner.count)), np.zeros(4, real)
    readings[0], readings[1], padded[:3] = first, second, sensor[0]
    lock, space = space_of(backend)
    with lock, space:
        space.upload("pair readings", readings)
        space.upload("match guesses", padded)
        space.run(scene, {}, lambda: _program(backend, space, scene, options), version=0)
        summary, numbers = np.empty(5), np.empty((turns, MATCH_RESULT), real)
        space.download(space.empty("pair summary", 5, _DOUBLE), summary)
        space.read(space.empty("match result", 2 * MATCH_RESULT, real), numbers)
        chosen, one, other, _, squares = summary.tolist()
        level, gap = float(scene.levels().noise[int(chosen)]), beams_by_angle(scanner, real)[4]
        points, noise = np.array([one, other], np.intp), np.array([level])
        device = PlacedPairs(backend, real, space, 2 * scanner.count, points, gap, _PAIR, [level])
        levels = Levels([options.at_noise(level)], [(int(one), int(other))], gap)
        lever = np.array([max(math.sqrt(squares / max(other, 1.0)), 1e-3)])
        # A second turn that did not run writes its number of iterations, 0, alone.
        ran = 2 if turns > 1 and numbers[1, 4] > 0 else 1
        result = numbers[:ran].astype(np.float64)
        again = result[1:] if ran > 1 else None
        best, sums = judged_pairs(
            device, sensor, result[:1], (one, other), lever, method, options, noise, levels, again
        )
    return finished(best, sums, lever, options, noise, mount)


def _program(backend: Backend, space: Workspace, scene: _Scene, options: MatchOptions) -> Program:
    """Return the launches that place a pair of scans and match them from a guess."""
    lanes, real, count = backend.info.lanes, scene.real, scene.scanner.count
    flags = flags_if(FLOAT64=real == np.float64)
    order, bearing, cosine, sine, gap = beams_by_angle(scene.scanner, real)
    levels, (places, *weights) = scene.levels(), neighbors(scene.scanner)
    size, step = len(weights[0]), places[0].step
    room = -(-size // _AT_ONCE) * _AT_ONCE
    weight = np.zeros((room, 2))
    weight[:size] = np.transpose(weights)
    nearest, farthest = range_limits(scene.kind, scene.scanner.range_min, scene.scanner.range_max)
    strides = max(count // COARSE_POINTS, 1)
    rules = [
        options.at_noise(noise).rules(COARSE_POINTS * stride, gap)
        for noise in levels.noise.tolist()
        for stride in range(1, strides + 1)
    ]
    buffers: dict[str, Any] = {
        name: space.empty(owner, numbers, dtype)
        for name, owner, numbers, dtype in (
            ("point", "match points", 8 * count, real), ("line", "match lines", 8 * count, real),
            ("start", "match start", 3, _INT), ("pair", "pair numbers", 3, _INT),
        )
    }  # fmt: skip
    placed = launch(
        "place_pair", with_lanes_flag(lanes, "place_pair", flags), (1,), **buffers,
        reading=space.empty("pair readings", 2 * count, _DOUBLE), work=space.empty("pair work", 4 * room, _DOUBLE),
        beam=backend.upload(np.stack([cosine, sine, bearing, order], axis=1)), weight=backend.upload(weight),
        level=backend.upload(np.array([levels.largest, [*map(slack_of, levels.noise.tolist())]]).T),
        summary=space.empty("pair summary", 5, _DOUBLE), beams=count, places=size, padded=room, step=step,
        nearest=nearest, farthest=farthest, levels=len(levels.noise), assumed=levels.assumed, coarse=COARSE_POINTS,
        strides=strides, **line_rules(WIDTH, gap),
    )  # fmt: skip
    matched = launch(
        "match_scans", with_lanes_flag(lanes, "match_scans", flags), (1,), **buffers,
        guess=space.empty("match guesses", 4, real), rules=backend.upload(np.array(rules, real)),
        result=space.empty("match result", 2 * MATCH_RESULT, real), scans=2, points=2 * count, pairs=1, starts=1,
        levels=len(rules), turns=scene.turns, far=POOR * scene.capture, far_turn=POOR_TURN,
    )  # fmt: skip
    return placed, matched
