"""``gpusense sweep``: tables, resuming, pictures, lists of jobs, failures, bad input."""

from __future__ import annotations

import json

import pytest
from support.command_line import error_of
from support.room_log import write_room

import gpusense as gs
from gpusense.commands import cli

PLAN = """
options: {limit: 3, beams: 20, range_max: 20, particles: 100}
axes:
  log:
    room: {log: run.log, map: map.yaml}
    absent: {log: absent.log, map: map.yaml}
  weights:
    plain: {temperature: 1.0}
    auto: {}
  seed: 2
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    write_room(folder, scans=3)
    (folder / "plan.yaml").write_text(PLAN)
    (folder / "good.yaml").write_text(PLAN.replace("    absent: {log: absent.log, map: map.yaml}\n", ""))
    return folder


def call(place, *more, plan="plan.yaml", table="t.csv"):
    return ["sweep", str(place / plan), "--table", str(place / table), "--device", "numpy", *more]


def test_a_plan_is_run_resumed_and_drawn(place, capsys):
    plot = place / "t.png"
    assert cli.main(call(place, "--plot", str(plot), plan="good.yaml")) == 0
    assert "DONE: 4 of 4 jobs ran in " in capsys.readouterr().out and plot.stat().st_size > 10_000
    assert "exists: resume it" in error_of(call(place), capsys)
    assert cli.main(call(place, "--resume", "--json")) == 1
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert (found["done"], found["failed"], found["skipped"]) == (0, 4, 4) and err.count("absent.log") == 4
    table = gs.sweep.read_table(place / "t.csv")
    assert table["status"] == ["done"] * 4 + ["failed"] * 4 and table["axis.log"][4] == "absent"
    assert cli.main(call(place, "--plot", str(place / "no.png"), "--resume", "--retry-failed")) == 1
    out = capsys.readouterr().out
    assert out.startswith("4 FAILED: 0 of 8 jobs ran in ") and "4 were in the table before" in out


def test_jobs_are_listed(place, capsys):
    assert cli.main(call(place, "--list", table="none.csv")) == 0
    out = capsys.readouterr().out
    assert "8 jobs" in out and "weights=plain" in out and not (place / "none.csv").exists()
    assert cli.main(call(place, "--list", "--json", table="none.csv")) == 0
    jobs = json.loads(capsys.readouterr().out)["jobs"]
    assert [job["key"] for job in jobs] == [job.key for job in gs.sweep.read_plan(place / "plan.yaml")]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--retry-failed"], "--retry-failed: must come with --resume"),
        (["--device", "numpy", "--processes", "3"], "--processes: must be the number of --device, 2, got 3"),
        (["--plot", "t.txt"], "must end in .png"),
        (["--tls-ca", "a.pem"], "must be given together, and with --dask and an address, got --tls-ca"),
        (
            ["--dask", "tls://127.0.0.1:9", "--tls-ca", "no.pem", "--tls-cert", "no.pem", "--tls-key", "no.pem"],
            "no.pem: must exist",
        ),
        (["--dask", "nowhere"], "dask: must be an address such as tcp://10.0.0.1:8786, got 'nowhere': missing port"),
    ],
)
def test_bad_input_is_one_line(place, capsys, more, message):
    assert message in error_of(call(place, *more, table="bad.csv"), capsys)
