"""Compare the answers of reports of different days: docs/error-vs-time.md should recommend the same methods.

    python bench/error_vs_time/agreement.py                      # all pairs of reports of a device in the history
    python bench/error_vs_time/agreement.py ONE.json TWO.json    # all pairs of these reports
    python bench/error_vs_time/agreement.py --history ONE.json   # of both
    python bench/error_vs_time/agreement.py --write              # the counts that page.py publishes, into agreement.csv

Two reports of a device are compared on the points or settings that both have, so a map or a setting that one of them
lacks makes no difference. The older answer stands until another one is clearly better, as on the page; "afresh" counts
the answers that are the same without that. Reports that another one extends are left out. Tasks of a processor that
were timed as whole runs, before 2026-11-26, are not compared with tasks that were timed step by step. Reports are of
different commits, so that some differences are due to the code.
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from commits import git
from error_vs_time.choices import SHOWN, WISHES, answer, chosen
from error_vs_time.reports import LISTS, ROWS, parsed

from gpusense._util.files import write_whole
from gpusense.evaluation.benchmark.report import table

COUNTS = Path(__file__).with_name("agreement.csv")

KEYS = {
    "models": ("scene", "cloud", "problem", "method", "variant", "knob", "value", "precision", "particles", "beams"),
    "tasks": ("need", "method", "setting", "precision"),
}


@dataclass(frozen=True)
class Report:
    """A report of one device.

    Attributes:
        name: Its file, commit and date.
        kind: ``"models"`` or ``"tasks"``.
        document: Its contents.
        measured: Its measured points or rows, by method and setting.
    """

    name: str
    kind: str
    document: Mapping[str, Any]
    measured: dict[tuple[Any, ...], Mapping[str, Any]] = field(default_factory=dict)

    @property
    def whole_runs(self) -> bool:
        """Tell whether a processor's tasks are timed as whole runs."""
        return self.kind == "tasks" and any(
            row["kind"] == "cpu" and not row.get("by_run") for row in self.measured.values()
        )

    def within(self, common: set[tuple[Any, ...]]) -> dict[str, Any]:
        """Return the document with only these points or rows."""
        kept = [point for key, point in self.measured.items() if key in common]
        return {**self.document, LISTS[self.kind]: kept}


@dataclass(frozen=True)
class Answer:
    """The answers of two reports to a wish.

    Attributes:
        device, wish: Title of the device, and the wish.
        old, new: Both answers with their figures.
        same: Whether they name the same method, where the older answer stands until another one is clearly better.
        afresh: Whether they do where it does not.
    """

    device: str
    wish: str
    old: str
    new: str
    same: bool
    afresh: bool


def report_of(name: str, text: str) -> Report | None:
    """Return a report from its text; None for one of another form, or of several devices."""
    kind = "tasks" if json.loads(text).get("kind") == "needs" else "models"
    try:
        document = parsed(text, name, kind)
    except ValueError:
        return None
    points = [point for point in document[LISTS[kind]] if point["backend"] != "outside"]
    able = [point for point in points if (point["status"] == "ok" if kind == "models" else point["seconds"])]
    measured = {tuple(point[name] for name in KEYS[kind]): point for point in able}
    name = f"{name}, {document['date']}"
    return Report(name, kind, document, measured) if len({point["backend"] for point in points}) == 1 else None


def history() -> Iterator[Report]:
    """Yield the reports of all commits, newest first, except those that a later report extends."""
    found: list[Report] = []
    listed = git("log", "--format=%h", "--name-only", "--diff-filter=AM", "--", "bench/results/error_vs_time_*.json")
    commit = ""
    for line in filter(None, listed.splitlines()):
        if not line.endswith(".json"):
            commit = line
            continue
        report = report_of(f"{Path(line).stem} at {commit}", git("show", f"{commit}:{line}"))
        if report is None or any(_extends(later, report) for later in found if later.kind == report.kind):
            continue
        found.append(report)
        yield report


def _extends(later: Report, report: Report) -> bool:
    """Return whether a report has the first measured point of another one, with its times."""
    first = next(iter(report.measured), None)
    return first is None or later.measured.get(first) == report.measured[first]


def compare(old: Report, new: Report) -> list[Answer]:
    """Return the answers of two reports of a kind to the wishes that both can answer; empty for other devices."""
    common = old.measured.keys() & new.measured.keys()
    rows = [
        [row for row in ROWS[one.kind](one.within(common)) if SHOWN[row.need][0] in row.errors] for one in (old, new)
    ]
    devices = [{row.device for row in each} for each in rows]
    answers = []
    for device, wish in itertools.product(sorted(devices[0] & devices[1]), WISHES):
        first, second = (chosen(each, wish, device) for each in rows)
        if first[0] is None or second[0] is None:
            continue
        standing = first[0].text
        later, kept = chosen(rows[1], wish, device, standing)
        same = later is not None and (later.text, kept) == (standing, first[1])
        afresh = (second[0].text, second[1]) == (standing, first[1])
        texts = answer(rows[0], wish, device), answer(rows[1], wish, device, standing)
        answers.append(Answer(device, wish.words, *texts, same, afresh))
    return answers


def pairs(reports: Sequence[Report]) -> Iterator[tuple[Report, Report, list[Answer]]]:
    """Yield all pairs of reports that can be compared, with their answers."""
    for new, old in itertools.combinations(reports, 2):
        answers = compare(old, new) if (old.kind, old.whole_runs) == (new.kind, new.whole_runs) else []
        if answers:
            yield old, new, answers


def summary(reports: Sequence[Report]) -> list[str]:
    """Return the table of pairs and that of differences."""
    shares, differences, total, equal, fresh = [], [], 0, 0, 0
    for old, new, answers in pairs(reports):
        same = sum(one.same for one in answers)
        afresh = sum(one.afresh for one in answers)
        total, equal, fresh = total + len(answers), equal + same, fresh + afresh
        shares.append((answers[0].device, old.name, new.name, f"{same} of {len(answers)}", f"{afresh}"))
        differences += [(one.device, one.wish, old.name, one.old, new.name, one.new) for one in answers if not one.same]
    lines = [f"{equal} of {total} answers of {len(shares)} pairs of reports are the same, {fresh} afresh.", ""]
    lines += table(("device", "older", "newer", "same", "afresh"), shares, 4)
    return [*lines, "", *table(("device", "to do", "older", "answer", "newer", "answer"), differences, 6)]


def counts(reports: Sequence[Report]) -> str:
    """Return how many pairs and answers each device has, how many are the same, and how many afresh, as CSV."""
    found: dict[tuple[str, str], list[int]] = {}
    for old, new, answers in pairs(reports):
        dates = {str(one.document["date"]) for one in (old, new)}
        row = found.setdefault((answers[0].device, "different dates" if len(dates) > 1 else "one date"), [0, 0, 0, 0])
        numbers = 1, len(answers), sum(one.same for one in answers), sum(one.afresh for one in answers)
        row[:] = [total + number for total, number in zip(row, numbers, strict=True)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("device", "reports of", "pairs", "answers", "same", "afresh"))
    writer.writerows([*key, *numbers] for key, numbers in sorted(found.items()))
    return stream.getvalue()


def main() -> int:
    """Print the tables; return 1 if answers differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reports", nargs="*", type=Path, help="reports of measure.py; default: those of the history")
    parser.add_argument("--history", action="store_true", help="the history's reports beside the others")
    parser.add_argument("--write", action="store_true", help=f"write {COUNTS.name} as well")
    arguments = parser.parse_args()
    try:
        reports = [report_of(file.name, file.read_text(encoding="utf-8")) for file in arguments.reports]
        reports += list(history()) if arguments.history or not reports else []
    except (OSError, ValueError, KeyError, subprocess.SubprocessError) as error:
        parser.error(f"{type(error).__name__}: {error}")
    read = [report for report in reports if report is not None]
    if arguments.write:
        write_whole(COUNTS, lambda stream: stream.write(counts(read).encode()))
    lines = summary(read)
    print("\n".join(lines))
    return int(lines[0].split()[0] != lines[0].split()[2])


if __name__ == "__main__":
    sys.exit(main())
