"""The page of error against run time: the script chooses and ranks like Python; a report's page in a browser."""

from __future__ import annotations

import json
import math
import random
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from support.bench_world import made_point, made_report, wrong

from gpusense.commands import cli
from gpusense.evaluation.benchmark import choice
from gpusense.evaluation.benchmark.report import ALL, Row, model_rows
from gpusense.plots import error_page as made

SCRIPT = (Path(made.__file__).parent / "pages" / "error.js").read_text(encoding="utf-8")
MEASURE = "rays wrong by more than a cell"


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def in_browser(page: str, script: str, folder: Path) -> dict[str, str]:
    """Open a page, run a script at its end, and return the texts in ``document.body.dataset``."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    file = folder / "page.html"
    file.write_text(page.replace("</html>", f"<script>{script}</script></html>"), encoding="utf-8")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
               "--dump-dom", file.as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    found = re.findall(r'data-(\w+)="([^"]*)"', re.search(r"<body[^>]*>", done.stdout)[0])
    return {name: unescape(text) for name, text in found}


def in_node(source: str) -> str:
    """Return the output of a script."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node is not installed")
    return subprocess.run([node, "-"], input=source, capture_output=True, text=True, check=True).stdout


def evaluated(code: str) -> Any:
    """Return the value of an expression that may use the functions of the page."""
    data = json.dumps({"rows": [], "origins": [], "text": ""})
    head = f"const document = {{getElementById: () => ({{textContent: {json.dumps(data)}}})}};\nconst module = 1;"
    return json.loads(in_node(f"{head}\n{SCRIPT}\nconsole.log(JSON.stringify({code}));"))


def test_the_script_chooses_as_python_does() -> None:
    listed = [
        ("a", 0.0, 5.0),
        ("b", 1e-9, 4.0),
        ("c", 0.3, 1.0),
        ("d", 0.2, 2.0),
        ("e", 0.21, 1.5),
        ("f", 0.9, 0.5),
        ("g", 0.31, 0.9),
    ]
    rows = json.dumps([{"name": name, "error": error, "time": time, "place": i}
                       for i, (name, error, time) in enumerate(listed)])  # fmt: skip
    budgets = [0.1, 0.6, 1.2, 1.6, 2.5, 4.5, 9.0]
    assert evaluated("[CLOSE, ALIKE]") == [choice.CLOSE, choice.ALIKE]
    front, chosen = evaluated(
        f"(list => [paretoFront(list).map(row => row.name), {budgets}.map(s => (recommended(list, s) ?? {{}}).name "
        f"?? null)])({rows})"
    )
    entries = [
        Row("rays", "d", ALL, name, "", "", "", time, (time,) * 3, {"e": error}, {}) for name, error, time in listed
    ]
    assert front == [entry.method for entry in choice.front(entries, "e")]
    found = [choice.choose(entries, "e", None, seconds) for seconds in budgets]
    assert chosen == [None if entry is None else entry.method for entry in found]
    assert chosen == [None, "f", "c", "e", "e", "b", "a"]


def performance_profile(times: dict[str, list[float | None]]) -> dict[str, list[tuple[float, float]]]:
    """Compute the share of problems that each solver solves within a factor tau of the fastest solver.

    For each solver the steps (tau, share) by rising tau; unsolved problems count in the denominator.
    """
    count = max((len(values) for values in times.values()), default=0)
    best = [min((v[i] or math.inf for v in times.values()), default=math.inf) for i in range(count)]
    profile = {}
    for solver, values in times.items():
        ratios = sorted(value / best[i] for i, value in enumerate(values) if value is not None)
        steps: list[tuple[float, float]] = []
        for solved, ratio in enumerate(ratios, 1):
            if steps and steps[-1][0] == ratio:
                steps.pop()
            steps.append((ratio, solved / count))
        profile[solver] = steps
    return profile


@pytest.mark.parametrize("seed", range(3))
def test_the_script_has_the_profiles_of_python(seed: int) -> None:
    """Five methods in six scenes have random times and errors, some unmeasured: steps are equal, best method first."""
    draw, limit = random.Random(seed), 0.4
    table = {
        name: [(draw.uniform(1, 9), draw.random()) if draw.random() < 0.8 else None for _ in range(6)]
        for name in "abcde"
    }
    rows = [
        {"method": name, "name": name, "outside": "", "errors": {"other": 0, "error": 1},
         "cases": [[f"s{i}", one[0], [0.0, one[1]]] for i, one in enumerate(each) if one]}
        for name, each in table.items()
    ]  # fmt: skip
    found = evaluated(f'profiles({json.dumps(rows)}, "error", {limit})')
    known = [i for i in range(6) if any(each[i] for each in table.values())]
    times = {
        name: [each[i][0] if each[i] and each[i][1] <= limit else None for i in known] for name, each in table.items()
    }
    steps = {name: own for name, own in performance_profile(times).items() if own}
    assert found["count"] == len(known) and {one["row"]["name"] for one in found["curves"]} == set(steps) != set()
    for one in found["curves"]:
        assert one["steps"] == [pytest.approx(step) for step in steps[one["row"]["name"]]]
    ranks = [(-one["share"], one["mean"]) for one in found["curves"]]
    assert ranks == sorted(ranks)


def test_the_script_shows_the_best_setting_of_a_method() -> None:
    def row(name: str, times: list[float]) -> dict[str, Any]:
        cases = [[f"s{i}", time, [0.0]] for i, time in enumerate(times)]
        return {"method": "m", "name": name, "outside": "", "errors": {"error": 0}, "cases": cases}

    rows = json.dumps([row("slow", [3, 3]), row("fast", [1, 2]), row("half", [1])])
    found = evaluated(f'profiles({rows}, "error", 1)')
    assert [one["row"]["name"] for one in found["curves"]] == ["fast"]


# ---- rows


def report_of(**changes: Any) -> dict[str, Any]:
    """Return a report of two maps: ``exact`` is twice as slow as ``march`` in the second, and right everywhere."""
    points = [
        made_point(scene=scene, cloud=cloud, method=method, code=f"make({method})", ranges=wrong(share),
                   processor_s=seconds, exact=method == "exact")
        for scene, method, share, seconds in (("one", "exact", 0.0, 0.004), ("two", "exact", 0.0, 0.016),
                                              ("one", "march", 0.2, 0.002), ("two", "march", 0.001, 0.008))
        for cloud in ("global", "tracking")
    ]  # fmt: skip
    machine = {"processors": 2, "processor": "X"}
    kept = {"points": points, "machine": machine, "command": "gpusense bench", "date": "2026-01-01", "commit": "abc"}
    return made_report() | kept | changes


def test_rows_have_each_scene() -> None:
    rows = {(row.method, row.scene): row for row in model_rows(report_of())}
    exact = rows["exact", ALL]
    assert [(case.name, case.seconds) for case in exact.cases] == [
        ("one, global", 0.004), ("one, tracking", 0.004), ("two, global", 0.016), ("two, tracking", 0.016),
    ]  # fmt: skip
    assert exact.seconds == pytest.approx(math.sqrt(0.004 * 0.016))
    assert rows["exact", "two"].seconds == pytest.approx(0.016)
    assert (exact.origin, exact.device) == ("gpusense bench (2026-01-01, commit abc)", "numpy")
    assert rows["march", ALL].errors[MEASURE] == 0.2 and rows["march", "one"].cases == ()


def test_a_scene_without_any_method_does_not_count() -> None:
    late = [made_point(scene="late", method=method, status="left out") for method in ("exact", "march")]
    half = made_point(scene="three", method="exact")
    report = report_of()
    for extra, maps in (([], {""}), (late, {""}), ([half, *late], {"", "4 of 5 clouds"})):
        rows = model_rows(report | {"points": [*report["points"], *extra]})
        assert {row.maps for row in rows if row.scene == ALL} == maps
    ((_, _, front),) = choice.choices(report | {"points": [*report["points"], *late]}, {"%": 1.0})
    assert {method for _, method, *_ in front} == {"exact"}


# ---- the page


def test_names_do_not_end_the_data() -> None:
    row = Row("rays", "d", "</script><b>", "m", "", "float32", "", 1.0, (1.0, 1.0, 1.0), {"e": 0.0}, {"e": "share"})
    text = made.error_page([row])
    assert "</script><b>" not in text and "\\u003c/script>\\u003cb>" in text and text.count("</script>") == 2


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_profiles_in_a_browser(tmp_path: Path) -> None:
    """The largest error decides which methods solve a scene; the best one is marked, and hovering names its command."""
    script = """
    const set = (name, value) => { $(name).value = value;
        for (const kind of ["change", "input"]) $(name).dispatchEvent(new Event(kind)); };
    const keep = name => { document.body.dataset[name] = $("answer").textContent; };
    set("view", "profile"); keep("middle"); set("limit", 1000); keep("loose");
    document.body.dataset.curves = document.querySelectorAll(".curve").length;
    document.querySelector(".curve").dispatchEvent(new MouseEvent("mousemove"));
    document.body.dataset.tip = $("tip").textContent;
    document.body.dataset.table = [...$("front").rows].map(row => row.cells[1].textContent).join("; ");
    """
    body = in_browser(made.error_page(model_rows(report_of())), script, tmp_path)
    assert body["middle"].startswith("4 scenes, error at most 1.4 %: exact solves 4, within 2 times the best time.")
    assert body["loose"].startswith("4 scenes, error at most 20 %: march solves 4, within 1 times the best time.")
    assert body["curves"] == "2" and body["table"] == "solved; 4 of 4; 4 of 4"
    assert "make(march)" in body["tip"] and "gpusense bench (2026-01-01, commit abc)" in body["tip"]


def test_the_command_writes_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "own.html"
    argv = ["bench", "--quick", "--particles", "8", "--checked", "6", "--beams", "7", "--repeats", "1",
            "--backend", "numpy", "--problem", "ranges", "--method", "exact", "--scene", "clutter"]  # fmt: skip
    assert cli.main([*argv, "--html", str(file)]) == 0
    text = file.read_text(encoding="utf-8")
    assert (
        '"need":"rays"' in text
        and "gs.RayCaster(grid, range_max" in text
        and "http" not in text.replace("http://www.w3.org/2000/svg", "")
    )
    for html in (tmp_path, tmp_path / "none" / "own.html"):
        assert cli.main([*argv, "--html", str(html)]) == 2
