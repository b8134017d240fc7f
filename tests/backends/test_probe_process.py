"""Child processes that work with drivers: reports, end, and time limit."""

from __future__ import annotations

import os
import sys
import textwrap
import time
from pathlib import Path

import pytest

from gpusense.backends import probe_process


@pytest.mark.parametrize("executable", ["", "/usr/bin/blender"])
def test_a_program_that_is_no_interpreter_is_not_started(monkeypatch, executable):
    monkeypatch.setattr(sys, "executable", executable)
    assert not probe_process.can_start()


def test_a_frozen_program_is_not_started(monkeypatch):
    assert probe_process.can_start()
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert not probe_process.can_start()


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "soon"])
def test_the_time_limit_is_a_number_of_seconds(monkeypatch, text):
    monkeypatch.setenv("GPUSENSE_PROOF_SECONDS", text)
    with pytest.raises(ValueError, match=rf"GPUSENSE_PROOF_SECONDS: must be a number of seconds > 0, got '{text}'"):
        probe_process.time_limit()


def run_text(text: str, **job):
    read = "import json, sys; job = json.loads(sys.stdin.readline())\n"
    return probe_process.run_text(["-c", read + textwrap.dedent(text)], job)


@pytest.mark.parametrize(
    ("text", "failure"),
    [
        ("print('gpusense-child {\"done\": \"%s\"}' % job['token'])", ""),
        ('print(\'gpusense-child {"done": "guessed"}\')', "ends the process with exit code 0, without an answer"),
        ("print('gpusense-child {\"a\": 1}')", "ends the process with exit code 0, without an answer"),
        ("import os; os._exit(0)", "ends the process with exit code 0, without an answer"),
        ("import sys; sys.exit(3)", "exit code 3"),
        ("raise ValueError('so it is')", "ValueError: so it is"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "ends the process with SIGSEGV"),
        (
            "import os, sys; sys.stderr.write('2 warnings generated.\\nLLVM ERROR: no\\n#0 0x1\\n'); os.abort()",
            "ends the process with SIGABRT (LLVM ERROR: no)",
        ),
        ("import os; os.write(1, bytes(range(256)) * 100); os.abort()", "ends the process with SIGABRT"),
    ],
)
def test_the_end_of_a_child_is_one_line(text, failure):
    outcome = run_text(text)
    assert (outcome.failure, outcome.conclusive) == (failure, True)


def test_a_child_reports_until_it_dies():
    text = """
    import os, sys
    print("noise")
    print('gpusense-child {"begin": 1}')
    print('a driver\\'s own words gpusense-child {"begin": 2}')
    print('gpusense-child {"cut": ', end="", flush=True)
    os.abort()
    """
    assert run_text(text).said == [{"begin": 1}, {"begin": 2}]


def test_a_hanging_child_and_its_children_are_ended(monkeypatch, tmp_path):
    monkeypatch.setenv("GPUSENSE_PROOF_SECONDS", "1.5")
    text = f"""
    import subprocess, sys, time
    started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    open({str(tmp_path / "pid")!r}, "w").write(str(started.pid))
    time.sleep(60)
    """
    outcome = run_text(text)
    assert (outcome.failure, outcome.conclusive) == ("hangs: no answer in 1.5 s", True)
    status = f"/proc/{(tmp_path / 'pid').read_text()}/stat"
    end = time.monotonic() + 20
    while os.path.exists(status) and Path(status).read_text().split()[2] not in "ZX":
        assert time.monotonic() < end, "what the child started still runs"
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("waits", "limits", "failure", "conclusive"),
    [(0, 600, "hangs: no answer in 0.1 s", True), (60, 600, "", True), (60, 2, "hangs: no answer in 0.1 s", False)],
)
def test_a_child_without_a_processor_gets_more_time(monkeypatch, waits, limits, failure, conclusive):
    monkeypatch.setenv("GPUSENSE_PROOF_SECONDS", "0.1")
    monkeypatch.setattr(probe_process, "_MOST_LIMITS", limits)
    monkeypatch.setattr(probe_process, "_starved", lambda _: waits)
    text = "import time; time.sleep(0.3); print('gpusense-child {\"done\": \"%s\"}' % job['token'])"
    outcome = run_text(text)
    assert (outcome.failure, outcome.conclusive) == (failure, conclusive)


@pytest.mark.skipif(not os.path.exists("/proc/self/schedstat"), reason="this system does not say how long threads wait")
def test_waits_of_threads_are_seconds():
    assert 0 < probe_process._starved(os.getpid()) < 1e5 and probe_process._starved(0) == 0


@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM", "SIGINT"])
def test_signals_from_outside_say_nothing_of_the_driver(name):
    outcome = run_text(f"import os, signal; signal.signal(2, signal.SIG_DFL); os.kill(os.getpid(), signal.{name})")
    assert outcome.failure == f"ends the process with {name}" and not outcome.conclusive


def test_an_interpreter_that_cannot_be_started_says_nothing_of_the_driver(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere/python3")
    outcome = probe_process.run({"do": "gpusense.evaluation.proof:prove"})
    assert outcome.failure.startswith("no child process can be started") and not outcome.conclusive
