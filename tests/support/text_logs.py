"""The name of a log of each text format, and lines with six scans of one laser."""

from __future__ import annotations

import pytest

from gpusense.logs.reader import FORMATS

# By the format's module.
LOGS = {
    "gpusense.logs.carmen": (
        "run.log",
        [f"FLASER 3 1.0 2.5 {3 + i}.0 0 0 0 0 0 0 {i}.5 host {i}.5" for i in range(6)],
    ),
    "gpusense.logs.wean": ("run.log", [f"L 0 0 0 0 0 0 {' '.join(['100'] * 180)} {i}.5" for i in range(6)]),
}
each_text_format = pytest.mark.parametrize("form", [each for each in FORMATS if not each.topics], ids=lambda f: f.name)
