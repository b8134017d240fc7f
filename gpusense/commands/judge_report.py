"""Reports of ``gpusense judge``: files, and the results as text or JSON."""

from __future__ import annotations

import argparse
import csv
import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gpusense._util.files import write_whole
from gpusense.commands.output import counted, length, print_fact, print_files, print_json, print_result
from gpusense.commands.stretches import print_stretches, stretch_rows
from gpusense.evaluation.machine import machine

if TYPE_CHECKING:
    from pathlib import Path

    from gpusense.evaluation.integrity import Integrity
    from gpusense.evaluation.judging import Judgement, Stretch
    from gpusense.evaluation.posed_scans import PosedScans
    from gpusense.world.grid import OccupancyGrid

    Trajectory = tuple[np.ndarray, np.ndarray]

_COLUMNS = ("scan", "time", "x", "y", "theta", "p_lost", "verdict", "explained", "radius", "error")


def report(
    args: argparse.Namespace, grid: OccupancyGrid, found: Judgement, posed: PosedScans, truth: Trajectory | None
) -> None:
    """Write the files, and print the results."""
    from gpusense.evaluation.judging import errors_of

    errors = np.full(len(found.times), math.nan) if truth is None else errors_of(found, *truth)
    known = np.isfinite(errors)
    rated: Integrity | None = None
    if truth is not None:
        from gpusense.evaluation.integrity import integrity

        rated = integrity(
            errors[known],
            found.radii[known],
            alert_limit=args.alert_limit,
            times=found.times[known] if (np.diff(found.times[known]) > 0).all() else None,
        )
    if args.csv is not None:
        _write_csv(args.csv, found, errors)
    if args.plot is not None:
        from gpusense.plots.drawing import save
        from gpusense.plots.judgements import judgement_figure

        save(judgement_figure(grid, found, rated, errors), args.plot)
    if args.record is not None:
        from gpusense.plots.viewer import Recording

        scans = [one.scan for one in posed.scans[: len(found.times)]]
        Recording(grid, "judge").write_judgement(found, scans, args.record)
    if args.json:
        print_json(_document(args, found, posed, rated, errors))
        return
    print_result(headline(found))
    print_fact("poses", f"{len(found.times)} of {counted(found.scans, 'scan')}, by {posed.source}")
    print_stretches(found.stretches, float(found.times[0]), found.risk)
    if rated is not None:
        _print_integrity(rated, found.risk)
    print_files(args.plot, args.csv, args.record)


def headline(found: Judgement) -> str:
    """Return the verdict in one line."""
    total, right = found.duration(), found.duration("tracking")
    if not found.informed:
        return f"no verdict: no scan of {_seconds(total)} has a reading to judge by"
    if len(found.times) == 1:
        (verdict,) = found.verdicts
        return f"{'right' if verdict == 'tracking' else verdict} at its only pose; p_lost {found.p_lost[0]:.2g}"
    lost = [one for one in found.stretches if one.verdict == "lost"]
    parts = [f"right for {_seconds(right, unit=False)} of {_seconds(total)}"]
    unsure = found.duration("uncertain")
    if lost:
        parts.append(_lost(lost, float(found.times[0])))
    if unsure:
        parts.append(f"uncertain for {_seconds(unsure)}")
    if len(parts) == 1:
        parts.append(f"p_lost at most {found.p_lost.max():.2g}")
    return "; ".join(parts)


def _lost(lost: Sequence[Stretch], begin: float) -> str:
    """Return when the poses were lost, and how far off."""
    off = max((one.off for one in lost if not math.isnan(one.off)), default=math.nan)
    away = "" if math.isnan(off) else f", {'up to ' if len(lost) > 1 else ''}{off:.1f} m off the likeliest place"
    if len(lost) == 1:
        return f"lost from {lost[0].start - begin:.1f} s to {lost[0].end - begin:.1f} s{away}"
    total = sum(one.duration for one in lost)
    return f"lost for {_seconds(total)} in {len(lost)} stretches, first from {lost[0].start - begin:.1f} s{away}"


def _seconds(time: float, *, unit: bool = True) -> str:
    return (f"{time:.0f}" if time >= 9.95 else f"{time:.1f}") + (" s" if unit else "")


def _print_integrity(rated: Integrity, risk: float) -> None:
    print_fact(
        "integrity",
        f"hazardously misleading {100 * rated.hazardous:.3g} %, misleading {100 * rated.misleading:.3g} %, available "
        f"{100 * rated.available:.3g} % of {counted(len(rated.errors), 'pose')} with a truth, at risk {risk:g} and "
        f"alert limit {rated.alert_limit:g} m",
    )
    print_fact("error", f"median {length(float(np.median(rated.errors)))}; above the radius in "
               f"{100 * rated.exceeded:.3g} % of the poses")  # fmt: skip
    delays = rated.times_to_alert
    if len(delays):
        alerted = delays[np.isfinite(delays)]
        longest = f", after at most {alerted.max():.2g} s" if len(alerted) else ""
        print_fact("alerts", f"{len(alerted)} of {counted(len(delays), 'error')} above the alert limit{longest}")


def _write_csv(path: Path, found: Judgement, errors: np.ndarray) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for k, verdict in enumerate(found.verdicts):
        x, y, theta = found.poses[k].tolist()
        numbers = [found.explained[k], found.radii[k], errors[k]]
        shown = ["" if math.isnan(number) else f"{number:.6g}" for number in numbers]
        writer.writerow([found.index[k], f"{found.times[k]:.6f}", f"{x:.6f}", f"{y:.6f}", f"{theta:.6f}",
                         f"{found.p_lost[k]:.6g}", verdict, *shown])  # fmt: skip
    write_whole(path, lambda stream: stream.write(text.getvalue().encode()))


def _document(
    args: argparse.Namespace, found: Judgement, posed: PosedScans, rated: Integrity | None, errors: np.ndarray
) -> dict[str, Any]:
    options = {name: value for name, value in vars(args).items() if name not in ("run", "command", "json")}
    seconds = {word: found.duration(word) for word in ("tracking", "uncertain", "lost")}
    columns = {name: getattr(found, name) for name in ("index", "times", "poses", "p_lost", "verdicts", "explained")}
    result = {
        "options": options, "verdict": headline(found), "lost": found.lost, "informed": found.informed,
        "scans": found.scans, "source": posed.source, "seconds": seconds, "risk": found.risk,
        "stretches": stretch_rows(found.stretches), **columns, "radii": found.radii, "integrity": None,
        "machine": machine(),
    }  # fmt: skip
    if rated is not None:
        result["errors"] = errors
        result["integrity"] = {
            "poses": len(rated.errors), "alert_limit": rated.alert_limit, "hazardous": rated.hazardous,
            "misleading": rated.misleading, "available": rated.available, "exceeded": rated.exceeded,
            "times_to_alert": rated.times_to_alert,
        }  # fmt: skip
    return result
