"""Write the tables of extreme sizes on a page, from the reports of extreme.py.

    python bench/accuracy/extreme_tables.py docs/numerics.md

The first table has the seconds of each size and device, the second the weights that are exactly 0 where the product of
densities is taken without logarithms. The script writes both between marks of the page; a test compares them with the
reports.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import table

REPORTS = Path(__file__).resolve().parents[1] / "results"
# Report, backend and heading of each column of seconds.
COLUMNS = (
    ("extreme-cpu", "opencl", "PoCL, 2 busy cores"),
    ("extreme-cpu", "warp", "Warp, 1 busy core"),
    ("extreme-h100", "opencl", "H100, OpenCL"),
    ("extreme-h100", "warp", "H100, CUDA"),
)
SIZES = ((1_000, 100_000), (1_000_000, 1_000), (10_000_000, 4))
MODELS = {"beam model": "beam", "field": "field"}
Row = dict[str, Any]


def write_tables(page: Path, tables: dict[str, str]) -> None:
    """Replace the text between the marks of a page."""
    text = page.read_text(encoding="utf-8")
    for name, lines in tables.items():
        begin, end = f"<!-- made: {name} -->", "<!-- end -->"
        if begin not in text:
            raise ValueError(f"{page.name}: must have the mark {begin}, got none")
        before, _, after = text.partition(begin)
        text = f"{before}{begin}\n{lines}\n{end}{after.partition(end)[2]}"
    page.write_text(text, encoding="utf-8")


def grouped(number: int) -> str:
    """Format a whole number in groups of three digits."""
    return f"{number:,}".replace(",", " ")


def row_of(rows: list[Row], backend: str, **values: Any) -> Row:
    """Return a backend's first row with these values."""
    return next(r for r in rows if r["backend"].startswith(backend) and all(r[k] == v for k, v in values.items()))


def rounded(number: float) -> str:
    """Format a number with two digits, or as a whole number in groups of three."""
    return grouped(round(number)) if number >= 100 else f"{number:#.2g}".removesuffix(".")


def seconds(row: Row) -> str:
    """Format the seconds of a row; a dash where it was left out."""
    return rounded(row["seconds"]) if "seconds" in row else "-"


def source(reports: dict[str, Any]) -> str:
    """Return a sentence that names the reports with their dates and commits."""
    made = (
        f"[{file}](../bench/results/{file}.json) of {report['machine']['date']}, commit {report['machine']['commit']}"
        for file, report in reports.items()
    )
    return f"By {' and '.join(made)}."


def sizes(reports: dict[str, Any]) -> str:
    """Format the seconds of long scans, large clouds and large maps."""
    lines = []
    for (particles, beams), (model, name) in ((size, one) for size in SIZES for one in MODELS.items()):
        found = [
            row_of(reports[file]["rows"]["sizes"], backend, particles=particles, beams=beams, model=model)
            for file, backend, _ in COLUMNS
        ]
        size = f"{grouped(particles)} x {grouped(beams)}"
        lines.append([size, name, *map(seconds, found), rounded(found[0]["effective"])])
    for model, name in MODELS.items():
        found = [row_of(reports[file]["rows"]["maps"], b, model=model, cloud="global") for file, b, _ in COLUMNS]
        cells = found[0]["cells"].replace("20000", "20 000")
        lines.append([f"10 000 x 60, {cells} cells, all in reach", name, *map(seconds, found), ""])
    columns = ("particles x beams", "model", *(head for _, _, head in COLUMNS), "effective particles")
    return f"{source(reports)}\n\n{table(columns, lines)}"


def zeros(reports: dict[str, Any]) -> str:
    """Format how many of 1000 weights are exactly 0 if the largest sum is not subtracted before the exponential."""
    rows = [r for r in reports["extreme-cpu"]["rows"]["products"] if r["backend"].startswith("opencl")]
    lines = []
    for beams, hits in dict.fromkeys((r["beams"], r["hits"]) for r in rows):
        counts = [
            " / ".join(
                str(row_of(rows, "opencl", beams=beams, model=model, cloud=cloud)["exp_of_sum_zero"])
                for cloud in ("tracking", "global")
            )
            for model in MODELS
        ]
        lines.append([f"{grouped(hits)} of {grouped(beams)}", *counts])
    return table(("hits of beams", *(f"{name}: tracking / global cloud" for name in MODELS)), lines)


def tables() -> dict[str, str]:
    """Return the tables by the names of their marks."""
    reports = {file: json.loads((REPORTS / f"{file}.json").read_text(encoding="utf-8")) for file, _, _ in COLUMNS}
    return {"extreme sizes": sizes(reports), "weights of zero": zeros(reports)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    write_tables(parser.parse_args().page, tables())
