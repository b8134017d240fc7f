"""Write error against run time as one interactive HTML page that fetches nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gpusense.evaluation.benchmark.report import Row

_PAGES = Path(__file__).parent / "pages"


def error_page(
    rows: Sequence[Row], shown: Mapping[str, Sequence[str]] | None = None, text: str = "", back: str = ""
) -> str:
    """Return the page: a figure of time over error, a budget, and performance profiles.

    A reader chooses need, device, map and error. The page marks the most exact method within the budget, by
    :func:`~gpusense.evaluation.benchmark.choice.choose`. The other view is the performance profile of Dolan and More
    (2002): the share of scenes that a method solves to a largest error within a factor of the best time.

    ``shown``: Texts of the measures on the page, by need; None for all.
    """
    origins = list(dict.fromkeys(row.origin for row in rows))
    order = sorted({row.preference for row in rows})
    lines = ",\n".join(_json(_plain(row, origins, shown) | {"place": order.index(row.preference)}) for row in rows)
    data = f'{{"origins":{_json(origins)},"text":{_json(text)},"rows":[\n{lines}]}}'
    page = (_PAGES / "error.html").read_text(encoding="utf-8")
    script = (_PAGES / "error.js").read_text(encoding="utf-8")
    link = f'<p class="note"><a href="{back}">Methods, measures and reports</a></p>' if back else ""
    return page.replace("<!--{back}-->", link).replace("/*{script}*/", script).replace("/*{data}*/", data)


def _plain(row: Row, origins: Sequence[str], shown: Mapping[str, Sequence[str]] | None) -> dict[str, Any]:
    measures = [name for name in (row.errors if shown is None else shown[row.need]) if name in row.errors]
    return {
        "need": row.need, "device": row.device, "map": row.scene, "name": row.text, "method": row.method,
        "setting": row.setting,
        "code": row.code, "outside": row.outside, "maps": row.maps, "time": _short(row.seconds),
        "quartiles": [_short(one) for one in row.quartiles],
        "errors": {name: _short(row.errors[name]) for name in measures},
        "units": [row.units[name] for name in measures],
        "cases": [
            [case.name, _short(case.seconds), [_short(case.errors[name]) if name in case.errors else None
                                               for name in measures]]
            for case in row.cases
        ],
        "origin": origins.index(row.origin),
    }  # fmt: skip


def _json(value: Any) -> str:
    """Format a value as JSON that cannot end its HTML element."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _short(number: float) -> float:
    return float(f"{number:.4g}")
