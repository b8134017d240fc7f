"""Signals that end a command: SIGTERM and SIGHUP act like Ctrl-C, and no unfinished file remains."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from support import landmark_log
from support.paths import ROOT
from support.room_log import write_room

from gpusense._util.interrupts import undisturbed
from gpusense.commands import cli, signals

ENDS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated"), signal.SIGHUP: (129, "hung up")}
PLAN = """
options: {limit: 3, beams: 20, range_max: 20, particles: 100}
axes:
  log: {room: {log: run.log, map: map.yaml}}
  seed: SEEDS
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("signals")
    write_room(folder)
    (folder / "plan.yaml").write_text(PLAN.replace("SEEDS", "4"))
    landmark_log.write_run(folder)
    return folder


@pytest.fixture(autouse=True)
def same_handlers():
    """Check that commands restore the program's handlers."""
    before = [signal.getsignal(number) for number in ENDS], sys.unraisablehook
    yield
    assert ([signal.getsignal(number) for number in ENDS], sys.unraisablehook) == before


LOG = ["--log", "run.log", "--range-max", "20", "--backend", "numpy"]
MAP = ["--map", "map.yaml"]
# Arguments of a command, the progress step of the signal, and the expected output at the end.
COMMANDS: dict[str, tuple[list[str], int, str]] = {
    "map": ([*LOG, "--out", "OUT/made.yaml"], 2, "results of 4 of 6 scans"),
    "likelihood_map": ([*MAP, *LOG, "--out", "OUT/made.png", "--headings", "4"], 2, "per cent of the positions"),
    "score": ([*MAP, *LOG, "--particles", "50"], 3, "results of 2 of 6 scans"),
    "match": (LOG, 2, "results of "),
    "features": ([*LOG, "--map-out", "OUT/made.csv"], 4, "results of 4 of 6 scans"),
    "localize": ([*MAP, *LOG, "--particles", "100", "--tum", "OUT/made.tum"], 4, "results of 3 of 6 scans"),
    "sweep": (["plan.yaml", "--table", "OUT/made.csv", "--device", "numpy"], 4, "made.csv has the finished jobs"),
    "landmarks": (["--folder", ".", "--robot", "1", "--backend", "numpy"], 3, "interrupted: results of 3 of "),
    "selftest": (["--backend", "numpy", "--backend", "warp:cpu"], 2, "INTERRUPTED after "),
    "bench": (["--quick", "--particles", "8", "--checked", "6", "--beams", "7", "--repeats", "1",
               "--backend", "numpy", "--scene", "clutter", "--method", "exact", "--output", "OUT"], 3, "exact"),
    "demo": (["--particles", "400", "--beams", "20", "--backend", "numpy", "--output", "OUT/made.png"], 3,
             "Beam model: the likeliest of"),
}  # fmt: skip
FILES = {"map": "made.yaml", "likelihood_map": "made.png", "localize": "made.tum", "sweep": "made.csv",
         "bench": "report.json", "features": "made.csv"}  # fmt: skip


def stop_at(monkeypatch: pytest.MonkeyPatch, command: str, number: int, step: int) -> None:
    """Send a signal when a command begins a step of its progress."""

    @contextlib.contextmanager
    def stopping(total: int) -> Any:
        begun = 0

        def show(text: str) -> None:
            nonlocal begun
            begun += 1
            if begun == step:
                os.kill(os.getpid(), number)

        yield show

    for module in ("signals", *(("sweep",) if command == "sweep" else ())):
        monkeypatch.setattr(f"gpusense.commands.{module}.progress", stopping)


@pytest.mark.parametrize(("command", "number"), list(zip(COMMANDS, itertools.cycle(ENDS), strict=False)))
def test_a_command_that_is_stopped_keeps_its_results(command, number, place, tmp_path, monkeypatch, capsys, needs):
    needs("warp")
    arguments, step, kept = COMMANDS[command]
    monkeypatch.chdir(place)
    monkeypatch.setattr("gpusense.commands.map._SCANS", 2)
    monkeypatch.setattr("gpusense.commands.features._CALL", 2)
    monkeypatch.setattr("gpusense.matching.pose_likelihood._TILE", 3000)
    monkeypatch.setattr("gpusense.evaluation.matching._BATCH", 2)
    stop_at(monkeypatch, command, number, step)
    code, word = ENDS[number]
    argv = [command.replace("_", "-"), *(word.replace("OUT", str(tmp_path)) for word in arguments)]
    assert cli.main(argv) == code
    out, err = capsys.readouterr()
    assert kept in out + err
    assert err.splitlines()[-1].startswith(f"gpusense: {word}")
    assert [path.name for path in tmp_path.rglob("*") if path.name.startswith(".")] == []
    if command in FILES:
        assert (tmp_path / FILES[command]).stat().st_size > 0


# ---- processes


def started(*arguments: str, cwd: Path, **options: Any) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "gpusense", *arguments], cwd=cwd, env=environment, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, **options,
    )  # fmt: skip


def test_signals_that_the_caller_ignores_stay_ignored(place, tmp_path):
    """The program nohup ignores SIGHUP."""
    process = started(
        "localize", *MAP, *LOG, "--particles", "100", "--tum", str(tmp_path / "made.tum"), cwd=place,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )  # fmt: skip
    for _ in range(20):
        time.sleep(0.05)
        process.send_signal(signal.SIGHUP)
    _, err = process.communicate(timeout=100)
    assert process.returncode in (0, 1) and (tmp_path / "made.tum").exists(), err


# ---- handlers


def test_the_library_installs_no_handler():
    code = (
        "import signal, sys; before = [signal.getsignal(n) for n in (2, 15, 1)], sys.unraisablehook; import gpusense, "
        "gpusense.commands.cli; assert ([signal.getsignal(n) for n in (2, 15, 1)], sys.unraisablehook) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": str(ROOT)})


def test_handlers_of_a_program_and_other_threads_are_left_alone():
    def own(number: int, frame: object) -> None: ...

    before = signal.signal(signal.SIGTERM, own)
    try:
        with signals.stopping():
            assert signal.getsignal(signal.SIGTERM) is own
            assert signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)
    seen: list[Any] = []

    def elsewhere() -> None:
        with signals.stopping(), signals.ending():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [before]


def test_a_forked_child_ends_by_the_signal():
    with signals.stopping():
        child = os.fork()
        if child == 0:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
            os._exit(7)
        _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGTERM


class Noisy:
    """An object whose destructor gets a signal."""

    number = signal.SIGTERM

    def __del__(self) -> None:
        os.kill(os.getpid(), self.number)
        time.sleep(0.001)


@pytest.mark.parametrize("number", ENDS, ids=lambda number: number.name)
def test_a_signal_in_a_destructor_is_not_lost(number):
    one = Noisy()
    one.number = number
    with pytest.raises(signals.Stopped) as stopped, signals.stopping():
        del one
        time.sleep(5)
    assert stopped.value.number == number


def test_other_errors_of_destructors_are_reported_as_before(capsys):
    class Failing:
        def __del__(self) -> None:
            raise ValueError("no interrupt")

    seen = []
    before, sys.unraisablehook = sys.unraisablehook, lambda lost: seen.append(str(lost.exc_value))
    try:
        with signals.stopping():
            Failing()
            gc.collect()
    finally:
        sys.unraisablehook = before
    assert seen == ["no interrupt"]


def test_the_wait_of_a_destructor_ends_before_the_interrupt():
    done = []

    class Waiting:
        def __del__(self) -> None:
            undisturbed(self.wait)

        def wait(self) -> None:
            if not done:
                done.append("interrupted")
                signal.raise_signal(signal.SIGINT)
            done.append("waited")

    def work() -> None:
        Waiting()
        done.append("after")
        time.sleep(5)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["interrupted", "waited", "after"]


def test_an_interrupt_while_memory_is_freed_is_not_lost(needs):
    """Freeing memory that host and device share waits for the device."""
    import numpy as np

    from gpusense.backends import get_backend

    device = get_backend(needs("opencl"))
    buffer = device.empty(1000, np.dtype(np.float64))
    if type(buffer).__name__ != "SharedBuffer":
        pytest.skip("the device has memory of its own")
    waited = []

    def settle() -> None:
        if not waited:
            waited.append(0)
            signal.raise_signal(signal.SIGINT)
        device.synchronize()
        waited.append(1)

    buffer._settle = settle
    with pytest.raises(KeyboardInterrupt):
        del buffer
        time.sleep(5)
    assert waited == [0, 1]
