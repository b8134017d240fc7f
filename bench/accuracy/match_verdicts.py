"""Compare the verdicts and covariances of scan matches with their actual errors.

    python bench/accuracy/match_verdicts.py --backend opencl --output bench/results/match_verdicts_cpu

``GPUSENSE_DATA`` names the folder of recorded data. ``corridors``: endless corridors, noise of 1 to 5 cm, 360 and 1081
beams over 360 and 270 degrees, three headings, guesses 0.3 m off along the corridor: matches reported as converged, and
the largest error over the deviation of a coordinate with a finite one. ``pairs``: neighbouring and unrelated places of
both halves of the recordings and of simulations (``bench/verdict_pairs.py``; half B is held out of all fits): stated
probabilities and observed shares with equal weight for right and wrong matches, the area under the ROC curve, unrelated
pairs that converged, and accepted right neighbours. ``nees``: squared errors over predicted ones (NEES / 3, with a
median of 0.79 and a mean of 1 for right covariances) of simulations, of loops of three scans, and against the reference
poses. The two matches of a loop's scan use different beams, so that its three matches are independent and need no
reference. ``few``: scans of 8 to 72 beams, to scans and to maps.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.matching import WRONG, WRONG_TURN, differences
from gpusense.evaluation.worlds import free_pose
from gpusense.matching.points import match_noise, scan_noise
from gpusense.matching.result import ScanMatch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, parse, publish, table
from verdict_pairs import HALF_A, HALF_B, recorded_pairs, recording, simulated_pairs

NOISES = (0.01, 0.02, 0.03, 0.05)
# Beams of a block of one set in loops, and steps between their scans by recording.
BLOCK, STEPS = 8, {"jarvis-s3000": 3, "jarvis-nav350": 3}
FEW = (8, 12, 16, 24, 36, 72)
BINS = 5
PARTS = ("corridors", "pairs", "nees", "few")


def corridor_scan(poses: np.ndarray, scanner: gs.Scanner) -> np.ndarray:
    """Return scans (S, K) in a corridor along x, 2.6 m wide."""
    sine = np.sin(scanner.bearings + poses[:, 2:])
    with np.errstate(divide="ignore"):
        ranges = np.where(sine > 0, 1.4 - poses[:, 1:2], -1.2 - poses[:, 1:2]) / sine
    return np.where(ranges < scanner.range_max, ranges, np.inf)


def off_by(match: ScanMatch, truth: np.ndarray) -> np.ndarray:
    """Return errors (S, 3) of poses."""
    off = match.pose - truth
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    return off


def corridors(backend: str, count: int, seed: int) -> list[list[str]]:
    """Return the rows of corridors."""
    rng, rows = np.random.default_rng(seed), []
    for beams in (360, 1081):
        for noise in NOISES:
            said, worst = [], []
            for half in (np.pi, 0.75 * np.pi):
                scanner = gs.Scanner.uniform(
                    angle_min=-half, angle_increment=2 * half / beams, count=beams, range_max=30.0
                )
                for heading in (0.0, 0.015, 0.3):
                    first = np.column_stack([np.zeros(count), rng.uniform(-0.4, 0.4, count), np.full(count, heading)])
                    second = first + rng.uniform(-1, 1, (count, 3)) * (0.3, 0.1, 0.1)
                    scans = [
                        corridor_scan(p, scanner) + noise * rng.normal(size=(count, beams)) for p in (first, second)
                    ]
                    truth = gs.pose_difference(first, second)
                    guess = truth + 0.3 * np.array([np.cos(heading), -np.sin(heading), 0.0])
                    match = gs.match_scan(*scans, scanner, guess, backend=backend)
                    deviation = np.sqrt(np.einsum("sii->si", match.covariance))
                    said.append(match.status)
                    worst.append((np.abs(off_by(match, truth)) / deviation).max(axis=1)[match.usable])
            status, ratio = np.concatenate(said), np.concatenate(worst)
            names, counts = np.unique(status, return_counts=True)
            others = ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True) if name != "converged")
            rows.append([
                str(beams), f"{100 * noise:g}", str(len(status)), f"{100 * (status == 'converged').mean():.2f}", others,
                f"{np.percentile(ratio, 99):.1f}",
            ])  # fmt: skip
    return rows


def pair_sets(backend: str, count: int, seed: int) -> Iterator[Any]:
    """Yield the pairs of both halves and of simulations."""
    for name in (*HALF_A, *HALF_B):
        yield from recorded_pairs(name, count, seed)
    yield from simulated_pairs(backend, count // 4, seed)


def area(said: np.ndarray, right: np.ndarray) -> float:
    """Return the area under the ROC curve."""
    rank = np.empty(len(said))
    rank[np.argsort(said, kind="stable")] = np.arange(len(said))
    positive = np.count_nonzero(right)
    return float((rank[right].sum() - positive * (positive - 1) / 2) / (positive * (len(said) - positive)))


def pairs(backend: str, count: int, seed: int) -> tuple[list[list[str]], list[list[str]]]:
    """Return the rows of verdicts and of the reliability diagram."""
    found: dict[str, list[Any]] = {"A": [], "B": [], "S": []}
    for each in pair_sets(backend, count, seed):
        match = each.match(backend)
        found[each.half].append(
            (np.full(len(match), each.kind), match.p_right, each.right(match), match.converged, match.usable,
             np.isin(match.status, ("converged", "unobservable", "ambiguous", "doubtful")))
        )  # fmt: skip
    verdicts, diagram = [], []
    for half, parts in found.items():
        kind, said, right, converged, usable, agree = (np.concatenate(part) for part in zip(*parts, strict=True))
        unrelated = kind == "unrelated"
        verdicts.append([
            half, str(len(kind)), f"{100 * converged[unrelated].mean():.2f}", f"{100 * usable[unrelated].mean():.1f}",
            f"{100 * converged[~unrelated].mean():.1f}", f"{100 * usable[~unrelated].mean():.1f}",
            f"{100 * right[usable & ~unrelated].mean():.1f}", f"{area(said[agree], right[agree]):.4f}",
        ])  # fmt: skip
        said, right = said[agree], right[agree]
        weight = np.where(right, 1 / right.sum(), 1 / (~right).sum())
        number = np.minimum((said * BINS).astype(int), BINS - 1)
        row = [half]
        for k in range(BINS):
            some = number == k
            means = [np.average(part[some], weights=weight[some]) if some.any() else np.nan for part in (said, right)]
            row.append(f"{means[0]:.2f}: {means[1]:.2f} ({some.sum()})")
        diagram.append(row)
    return verdicts, diagram


def composed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return (S, 3) poses of frames in frames in frames."""
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    x, y, turn = second.T
    return np.stack([first[:, 0] + c * x - s * y, first[:, 1] + s * x + c * y, first[:, 2] + turn], axis=1)


def loop_squares(matches: list[ScanMatch]) -> tuple[np.ndarray, np.ndarray]:
    """Return squared loop errors over predicted ones (S,), and loop errors, of matches i to j, j to k, and i to k."""
    one, two, both = matches
    end = composed(one.pose, two.pose)
    loop = gs.pose_difference(both.pose, end)
    # Derivatives of the end, in the frame of scan k by the third match, with respect to the three poses.
    c, s = np.cos(both.pose[:, 2]), np.sin(both.pose[:, 2])
    zero, unit = np.zeros(len(c)), np.ones(len(c))
    back = np.stack([c, s, zero, -s, c, zero, zero, zero, unit], axis=1).reshape(-1, 3, 3)
    total = np.zeros((len(c), 3, 3))
    for match, pivot, turned in ((one, one.pose, False), (two, one.pose, True), (both, both.pose, False)):
        jacobian = np.tile(np.eye(3), (len(c), 1, 1))
        if turned:
            c1, s1 = np.cos(pivot[:, 2]), np.sin(pivot[:, 2])
            jacobian[:, :2, :2] = np.stack([c1, -s1, s1, c1], axis=1).reshape(-1, 2, 2)
            pivot = end
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -(end - pivot)[:, 1], (end - pivot)[:, 0]
        jacobian = back @ jacobian
        total += jacobian @ match.covariance @ jacobian.transpose(0, 2, 1)
    return np.einsum("si,sij,sj->s", loop, np.linalg.inv(total), loop) / 3, loop


def loops(name: str, backend: str, count: int, seed: int) -> list[str]:
    """Return the row of a recording: NEES of loops and against the references, and deviations of both."""
    ranges, scanner, poses, _ = recording(name)
    step, rng = STEPS.get(name, 1), np.random.default_rng(seed)
    i = np.sort(rng.choice(len(ranges) - 2 * step, min(count, len(ranges) - 2 * step), replace=False))
    odd = np.where(np.arange(scanner.count) // BLOCK % 2, 0.0, np.nan)
    even = np.where(np.isnan(odd), 0.0, np.nan)
    own = scan_noise(ranges, scanner)
    noise = float(np.median(match_noise(own, own)))
    matches, errors = [], []
    for first, second, a, b in (
        (i, i + step, odd, odd),
        (i + step, i + 2 * step, even, even),
        (i, i + 2 * step, even, odd),
    ):
        truth = gs.pose_difference(poses[first], poses[second])
        match = gs.match_scan(ranges[first] + a, ranges[second] + b, scanner, truth, backend=backend, noise=noise)
        matches.append(match)
        distance, turn = differences(match.pose, truth)
        errors.append((distance < WRONG) & (turn < WRONG_TURN) & match.converged)
    good = np.logical_and.reduce(errors)
    squares, loop = loop_squares([ScanMatch.ordered(match, np.flatnonzero(good)) for match in matches])
    whole = gs.match_scan(
        ranges[i], ranges[i + step], scanner, gs.pose_difference(poses[i], poses[i + step]), backend=backend
    )
    off = off_by(whole, gs.pose_difference(poses[i], poses[i + step]))
    right = whole.converged & (np.hypot(off[:, 0], off[:, 1]) < WRONG) & (np.abs(off[:, 2]) < WRONG_TURN)
    reference = np.einsum("si,sij,sj->s", off[right], np.linalg.inv(whole.covariance[right]), off[right]) / 3
    deviation = np.sqrt(np.einsum("sii->si", whole.covariance[right])[:, :2].sum(axis=1))
    distance = np.hypot(off[right, 0], off[right, 1])
    rest = max(np.median(distance**2) - np.median(deviation**2) * np.log(2), 0.0)
    return [
        "A" if name in HALF_A else "B", name, str(len(squares)), f"{np.median(squares):.2f} / {squares.mean():.2f}",
        f"{1e3 * np.median(np.hypot(loop[:, 0], loop[:, 1])):.1f}", f"{np.median(reference):.1f}",
        f"{1e3 * np.median(deviation):.1f}", f"{1e3 * np.median(distance):.1f}", f"{1e3 * np.sqrt(rest):.0f}",
    ]  # fmt: skip


def nees_simulated(backend: str, count: int, seed: int) -> list[list[str]]:
    """Return the rows of simulated pairs in generated buildings, noise of 0.5 to 3 cm, 361 and 1081 beams."""
    rng, rows = np.random.default_rng(seed), []
    for beams in (361, 1081):
        scanner = gs.Scanner.uniform(angle_min=-2.36, angle_increment=4.72 / beams, count=beams, range_max=30.0)
        for noise in (0.005, 0.01, 0.02, 0.03):
            squares = []
            for i in range(4):
                grid = gs.worlds.building(i)
                first = np.array([free_pose(grid, rng) for _ in range(count // 4)])
                second = first + rng.uniform(-1, 1, first.shape) * (0.4, 0.4, 0.2)
                caster = gs.RayCaster(grid, scanner.range_max, backend=backend)
                exact = [caster.cast(poses, scanner.bearings).astype(np.float64) for poses in (first, second)]
                seen = (exact[0].min(axis=1) > 0.1) & (exact[1].min(axis=1) > 0.1)
                one, two = (z[seen] + noise * rng.normal(size=z[seen].shape) * (z[seen] < 30.0) for z in exact)
                truth = gs.pose_difference(first, second)[seen]
                guess = truth + rng.uniform(-1, 1, truth.shape) * (0.1, 0.1, 0.05)
                match = gs.match_scan(one, two, scanner, guess, backend=backend)
                off = off_by(match, truth)
                some = match.converged & (np.hypot(off[:, 0], off[:, 1]) < WRONG) & (np.abs(off[:, 2]) < WRONG_TURN)
                squares.append(
                    np.einsum("si,sij,sj->s", off[some], np.linalg.inv(match.covariance[some]), off[some]) / 3
                )
            values = np.concatenate(squares)
            rows.append(
                [str(beams), f"{100 * noise:g}", str(len(values)), f"{values.mean():.2f}", f"{np.median(values):.2f}"]
            )
    return rows


def few(backend: str, count: int, seed: int) -> list[list[str]]:
    """Return the rows of scans of few beams over a full turn, with 1 cm of noise, guesses off by up to 15 cm."""
    rng, rows = np.random.default_rng(seed), []
    for beams in FEW:
        scanner = gs.Scanner.uniform(angle_min=-np.pi, angle_increment=2 * np.pi / beams, count=beams, range_max=20.0)
        for to in ("map", "scan"):
            matches, truths = [], []
            for i in range(2):
                grid = gs.worlds.building(i)
                caster = gs.RayCaster(grid, scanner.range_max, backend=backend)
                first = np.array([free_pose(grid, rng) for _ in range(count)])
                second = first + rng.uniform(-1, 1, first.shape) * (0.4, 0.4, 0.15)
                exact = [caster.cast(poses, scanner.bearings).astype(np.float64) for poses in (first, second)]
                seen = (exact[0].min(axis=1) > 0.1) & (exact[1].min(axis=1) > 0.1)
                one, two = (np.where(z < 20, z + rng.normal(0, 0.01, z.shape), np.inf)[seen] for z in exact)
                truth = second[seen] if to == "map" else gs.pose_difference(first, second)[seen]
                guess = truth + rng.uniform(-1, 1, truth.shape) * (0.15, 0.15, 0.08)
                matches.append(gs.match_scan(grid if to == "map" else one, two, scanner, guess, backend=backend))
                truths.append(truth)
            match, truth = ScanMatch.joined(matches), np.concatenate(truths)
            off, seen = off_by(match, truth), match.usable
            observed = np.maximum((match.eigenvalues > 0).sum(axis=1), 1)
            squares = np.einsum("si,sij,sj->s", off, match.information, off) / observed
            distance = np.hypot(off[:, 0], off[:, 1])
            names, counts = np.unique(match.status, return_counts=True)
            if seen.any():
                middle, most = 1e3 * np.percentile(distance[seen], [50, 95])
                figures = [f"{middle:.0f} / {most:.0f}", f"{np.median(squares[seen]):.2f}",
                           f"{match.p_right[seen].mean():.2f}"]  # fmt: skip
            else:
                figures = ["-"] * 3
            statuses = ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True))
            rows.append([str(beams), to, statuses, *figures])
    return rows


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish the tables."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--count", type=int, default=200, help="matches of a setting (default: %(default)s)")
    parser.add_argument("--part", action="append", choices=PARTS, help="default: all")
    arguments = parse(parser, argv)
    backend, count, seed, parts = arguments.backend, arguments.count, arguments.seed, arguments.part or PARTS
    texts, rows = [], {}

    def add(key: str, title: str, columns: list[str], lines: list[list[str]]) -> None:
        rows[key] = [dict(zip(columns, line, strict=True)) for line in lines]
        texts.append(f"{title}\n\n{table(columns, lines)}")

    if "corridors" in parts:
        columns = ["beams", "noise cm", "matches", "converged %", "others", "99 % of error / deviation"]
        add("corridors", "Corridors", columns, corridors(backend, count, seed))
    if "pairs" in parts:
        verdicts, diagram = pairs(backend, count, seed)
        add("pairs", "Verdicts", ["half", "pairs", "unrelated: converged %", "usable %", "neighbours: converged %",
                                  "usable %, neighbours", "of these right %", "AUROC"], verdicts)  # fmt: skip
        add("diagram", "p_right said: happened (matches)", ["half", *(f"bin {k + 1}" for k in range(BINS))], diagram)
    if "nees" in parts:
        add("nees", "NEES / 3, simulated", ["beams", "noise cm", "matches", "mean", "median"],
            nees_simulated(backend, count, seed))  # fmt: skip
        columns = [
            "half", "recording", "loops", "NEES / 3 of loops, median / mean", "loop mm",
            "NEES / 3 against references, median", "deviation mm", "off the references mm",
            "of these the references' mm",
        ]  # fmt: skip
        add("loops", "NEES / 3, recorded", columns, [loops(name, backend, count, seed) for name in (*HALF_A, *HALF_B)])
    if "few" in parts:
        add("few", "Few beams", ["beams", "to", "statuses", "median / p95 mm", "NEES", "mean p_right"],
            few(backend, count // 2, seed))  # fmt: skip
    publish(__file__, arguments, "\n\n".join(texts), {"rows": rows})


if __name__ == "__main__":
    main()
