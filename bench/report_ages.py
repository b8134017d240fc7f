"""List how old reports are: the number of commits since their own that touch the measured code.

    python bench/report_ages.py               # all reports, the oldest first
    python bench/report_ages.py --most 300    # exit with 1 where a report is older

A report is a file of bench/results, a section of a file's first level, or an element of its list. It states its commit,
or that with which it was published; of several the oldest counts. Commits count that touch kernels/ or gpusense/. An
unknown age, of a report without commit or with one that this clone lacks, is the oldest.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from commits import ROOT, commits_since
from common import table

RESULTS = ROOT / "bench" / "results"
CODE = ("kernels", "gpusense")
COMMIT = re.compile(r'(?:commit"?:?|published_with":) "?([0-9a-f]{7,12})\b')


def parts_of(file: Path) -> list[str]:
    """Return the reports of a file: the elements of a list, or the sections of the first level."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".json":
        whole = json.loads(text)
        return [json.dumps(one) for one in whole] if isinstance(whole, list) else [text]
    return [part for part in re.split(r"(?m)^(?=# )", text) if part.strip()]


def ages(folder: Path = RESULTS, root: Path = ROOT) -> Iterator[tuple[float, str, str]]:
    """Yield age, name and commit of each report in a folder."""
    for file in sorted(file for file in folder.iterdir() if file.suffix in (".md", ".json")):
        parts = parts_of(file)
        for number, part in enumerate(parts):
            heading = re.match(r'# (.+)|\{"title": "([^"]+)"', part)
            title = next(filter(None, heading.groups())) if heading else f"{number + 1}"
            name = file.name if len(parts) == 1 else f"{file.name}, {title}"
            stated = [(commits_since(commit, CODE, root=root), commit) for commit in sorted(set(COMMIT.findall(part)))]
            age, commit = max(stated, default=(math.inf, "none"))
            yield age, name, commit


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; return 1 where a report is older than ``--most``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=float, default=math.inf, help="most commits (default: any number)")
    most = parser.parse_args(argv).most
    rows = sorted(ages(), key=lambda row: (-row[0], row[1]))
    lines = [("unknown" if math.isinf(age) else age, name, commit) for age, name, commit in rows]
    print(table(("commits behind", "report", "commit"), lines))
    return int(any(age > most for age, _, _ in rows))


if __name__ == "__main__":
    sys.exit(main())
