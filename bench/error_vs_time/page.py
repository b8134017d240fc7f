"""Make docs/error-vs-time.md and its figures from the reports in bench/results, and standing.csv beside this script.

    python bench/error_vs_time/page.py           # write
    python bench/error_vs_time/page.py --check   # exit code 1 if a file differs or a report is of older code

The same reports give the same bytes everywhere. Answers of the last page, which standing.csv lists, stand until reports
show a method that is clearly better. The build of the site writes the interactive page.
"""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import table
from error_vs_time.charts import Chart, Mark, drawing
from error_vs_time.choices import (
    KL,
    SHOWN,
    WISHES,
    WRONG,
    Standing,
    answers,
    lead,
    own,
    standing_of,
    value,
)
from error_vs_time.reports import LIMIT, RESULTS, ROOT, Source, commit_trouble, rows_of, sources

from gpusense._util.files import write_whole
from gpusense.evaluation.benchmark.choice import front, time_text
from gpusense.evaluation.benchmark.report import ALL, Row
from gpusense.plots.error_page import error_page

HERE = Path(__file__).parent
PAGE = Path("docs/error-vs-time.md")
IMAGES = Path("docs/img")
STANDING = Path("bench/error_vs_time/standing.csv")
NEEDS = tuple(SHOWN)
# Scans of the drive in reports that do not state them.
DRIVE = {"scans": 60, "settling": 10}
# Methods with a knob that other implementations share.
TABLES = ("cddt", "lookup", "march, centre")


def best(rows: Sequence[Row], measure: str) -> list[Row]:
    """Return the Pareto front of the rows of all maps."""
    return front([row for row in rows if not row.maps], measure)


def chart(rows: Sequence[Row], need: str, devices: Sequence[str]) -> str:
    """Draw the chart of a need: a panel for each device, with the methods of gpusense and of others."""
    measure, charts = SHOWN[need][0], []
    for device in devices:
        chosen = [row for row in rows if (row.need, row.device, row.scene) == (need, device, ALL)]
        if not chosen:
            continue
        kept = best([row for row in chosen if not row.outside], measure)
        marks = [Mark(row.errors[measure], row.seconds, row.text, row.method, row in kept) for row in chosen]
        charts.append(Chart(device, f"{measure} [{chosen[0].units[measure]}]", marks))
    return drawing(charts)


def methods(rows: Sequence[Row], need: str, devices: Sequence[str], *, fronts: bool = False) -> list[str]:
    """Return the table of a need: times on all devices, errors and code; of many settings only the Pareto fronts."""
    measures = SHOWN[need]
    shown: dict[str, dict[str, Row]] = {}
    for device in devices:
        chosen = own(rows, need, device)
        for row in best(chosen, measures[0]) if fronts else chosen:
            shown.setdefault(row.text, {})[device] = row
    devices = [device for device in devices if any(device in each for each in shown.values())]
    columns = ["method", *devices, *measures, "code"]
    lines = []
    for text, each in shown.items():
        first = next(iter(each.values()))
        worst = [max(row.errors.get(name, 0.0) for row in each.values()) for name in measures]
        known = [name in first.errors for name in measures]
        lines.append([
            f"**{text}**" if first.exact else text, *(_time(each.get(device)) for device in devices),
            *(value(error, first.units[name]) if there else "-"
              for error, name, there in zip(worst, measures, known, strict=True)),
            f"`{first.code}`",
        ])  # fmt: skip
    return [table(columns, lines)]


def _time(row: Row | None) -> str:
    if row is None:
        return "-"
    low, _, high = (time_text(seconds) for seconds in row.quartiles)
    return f"{time_text(row.seconds)} ({low} to {high})"


def peers(rows: Sequence[Row]) -> list[str]:
    """Return the table of other implementations and of comparable rows of gpusense."""
    lines, outside = [], [row for row in rows if row.outside and row.scene == ALL]
    for need in ("rays", "beam model", "likelihood field"):
        measure = SHOWN[need][0]
        for device in dict.fromkeys(row.device for row in outside if row.need == need):
            rivals = [row for row in outside if (row.need, row.device) == (need, device)]
            single = [row for row in own(rows, need, device) if row.precision == "float32"]
            rivals += [row for row in single if not row.setting or row.method in TABLES]
            for row in sorted(rivals, key=lambda one: one.seconds):
                rate = row.work / row.seconds / 1e6
                error = value(row.errors[measure], row.units[measure]) + " nats" * (need != "rays")
                lines.append((need, row.text, row.outside or "gpusense", f"{rate:.3g}", error, device))
    return [table(("for", "method", "version, threads", "M/s of one core, whole calls", "error", "processor"), lines)]


def rivals(rows: Sequence[Row], need: str, of: str) -> list[str]:
    """Return the table of other programs for a task and of gpusense's rows of the same settings."""
    outside = [row for row in rows if row.outside and row.need == need]
    lines, settings = [], {row.setting for row in outside}
    for device in dict.fromkeys(row.device for row in outside):
        reference = [row for row in own(rows, need, device) if row.precision == "float32"]
        listed = [row for row in [*outside, *reference] if row.device == device and row.setting in settings]
        for row in sorted(listed, key=lambda one: (int(one.setting.split()[0]), one.seconds)):
            errors = [value(row.errors[name], "m") for name in SHOWN[need]]
            times = time_text(row.seconds), time_text(row.quartiles[1])
            lines.append((row.method, row.setting, row.outside or "gpusense", *times, *errors, device))
    columns = ("method", "setting", "version, threads", f"{of}, one core", "elapsed", *SHOWN[need], "processor")
    missing = "None in these reports; an [earlier run](../bench/results/other_programs.md) has some."
    return [table(columns, lines) if lines else missing]


def by_map(rows: Sequence[Row], devices: Sequence[str]) -> list[str]:
    """Return the rates of the exact caster in each map, and the error of a quarter of the beams."""
    known = {(row.need, row.text, row.device, row.scene): row for row in rows}
    lines = []
    for (need, text, device, scene), row in known.items():
        if (need, text) == ("rays", "exact") and device in devices:
            rate, wrong = row.work / row.seconds / 1e6, value(row.errors[WRONG], "share")
            thin = known.get(("beam model", "exact, fewer beams, every = 4", device, scene))
            lines.append((device, scene, f"{rate:.4g}", wrong, value(thin.errors[KL], "nats") if thin else "-"))
    return [table(("device", "map", "M rays/s, exact, whole calls", "wrong", "nats, every 4th beam"), lines)]


def listing(found: Sequence[Source]) -> list[str]:
    """Return the table of the reports."""
    lines = [
        (f"[{source.name}](../bench/results/{source.name})", "; ".join(source.titles), str(source.report["date"]),
         str(source.report["commit"]), source.missing, f"`{source.report['command']}`")
        for source in found
    ]  # fmt: skip
    return [table(("report", "devices", "date", "commit", "not measured", "command"), lines)]


def drive(found: Sequence[Source]) -> list[str]:
    """Return the sentence on the scans of the drive that count."""
    drives = {tuple(one.report.get("drive", DRIVE).values()) for one in found if one.kind == "tasks"}
    return [
        f"The first {settling} of {scans} scans count neither for errors nor for times"
        + ("; a filter's first 60 scans also teach the temperature." if settling < 60 else ".")
        for scans, settling in sorted(drives)[:1]
    ]


def picture(name: str) -> Path:
    """Return the path of a need's figure."""
    return IMAGES / f"error-vs-time-{name.replace(' ', '-')}.svg"


def interactive(folder: Path = RESULTS) -> str:
    """Return the interactive page."""
    return error_page(rows_of(sources(folder)), SHOWN, back="../docs/error-vs-time.html")


def last_answers() -> Standing:
    """Return the answers of the last page by device and wish; empty before the first page."""
    if not (ROOT / STANDING).is_file():
        return {}
    with (ROOT / STANDING).open(encoding="utf-8", newline="") as stream:
        return {(row["device"], row["to do"]): row["answer"] for row in csv.DictReader(stream)}


def _written(standing: Standing) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([("device", "to do", "answer"), *(sorted((*key, text) for key, text in standing.items()))])
    return stream.getvalue()


def files(folder: Path = RESULTS, last: Standing | None = None) -> dict[Path, str]:
    """Return all files of the page by their paths in the checkout; ``last`` replaces the answers of standing.csv."""
    found = sources(folder)
    every = rows_of(found)
    # A table that took too long for all tracking clouds lacks the need's first measure of error.
    rows = [row for row in every if SHOWN[row.need][0] in row.errors]
    if not rows:
        raise ValueError(f"reports: {folder.name} must have reports error_vs_time_*.json, got none")
    devices = list(dict.fromkeys(row.device for row in rows))
    needs = [need for need in NEEDS if any(row.need == need for row in rows)]
    made = {picture(need): chart(rows, need, devices) for need in needs}
    standing = standing_of(rows, devices, last_answers() if last is None else last)
    made[STANDING] = _written(standing)
    blocks = {
        "lead": lead(rows, devices, standing), "answers": answers(rows, devices, WISHES, standing),
        "peers": peers(rows),
        "matchers": rivals(rows, "matching", "a match"), "filters": rivals(rows, "localisation", "a scan"),
        "drive": drive(found), "maps": by_map(rows, devices), "reports": listing(found), "limit": [str(LIMIT)],
    }  # fmt: skip
    for need in NEEDS:
        blocks[need] = methods(rows, need, devices, fronts=need == "localisation") if need in needs else ["(none yet)"]
        words = f"{need}: error against time"
        blocks[f"figure {need}"] = [f"![{words}](img/{picture(need).name})"] if need in needs else []
    text = (HERE / "template.txt").read_text(encoding="utf-8")
    for name, lines in blocks.items():
        text = text.replace(f"{{{{{name}}}}}", "\n".join(lines))
    return made | {PAGE: text}


def main() -> int:
    """Write the files, or check them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    arguments = parser.parse_args()
    try:
        made, found = files(), sources()
    except (OSError, ValueError) as error:
        parser.error(str(error))
    troubles = [f"{source.name} {trouble}" for source in found if (trouble := commit_trouble(source.report["commit"]))]
    for path, text in made.items():
        if not arguments.check:
            write_whole(ROOT / path, lambda stream, text=text: stream.write(text.encode()))
        elif not (ROOT / path).is_file() or (ROOT / path).read_text(encoding="utf-8") != text:
            troubles.append(f"{path} differs from what the reports give")
    print("\n".join([f"{len(made)} files of {len(found)} reports", *troubles]))
    return int(bool(troubles))


if __name__ == "__main__":
    sys.exit(main())
