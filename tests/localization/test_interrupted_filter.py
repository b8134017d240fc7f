"""A call of a filter interrupted at any line has changed all of the filter's state or none.

Tests of models cover interrupts in models and devices; these cover the filter's own state.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.filter_scene import COVARIANCE, FILTERS, START, Filter, begun, everything, odometry, readings
from support.interrupts import Line, executed_lines, interrupt
from support.tracking_scene import field

import gpusense as gs
from gpusense.backends.base import Exchange
from gpusense.localization import journal, lessons, rival, sensors, starts

# Rooms with lines to interrupt: lower rooms do not use filters.
ROOMS = ("localization", "sweeps")
CALLS: dict[str, Callable[[Filter], Any]] = {
    "predict": lambda pf: pf.predict(*odometry(4)),
    "correct": lambda pf: pf.correct(readings(pf, 3)),
    "estimate": lambda pf: pf.estimate(),
    "host_weights": lambda pf: pf.host_weights(),
    "flush": lambda pf: pf.flush(),
    "reset": lambda pf: pf.reset(),
    "initialize": lambda pf: pf.initialize(mean=START, covariance=COVARIANCE, particles=40),
    "initialize_uniform": lambda pf: pf.initialize_uniform(bounds=((1.0, 1.0), (4.0, 4.0))),
    "restore": lambda pf: pf.restore(OTHER_STATES.setdefault(repr(pf.state().options), begun(again(pf), 1).state())),
}
OTHER_STATES: dict[str, Any] = {}
# Calls that run the motion, and change nothing else.
LOOKS = ("estimate", "host_weights", "flush")


@pytest.fixture(autouse=True)
def few_tries(monkeypatch):
    """Let a reset try few poses, since atomicity is independent of their number."""
    monkeypatch.setattr(starts, "_LEAST_TRIES", 300)


def again(pf: Filter) -> Filter:
    """Return a new filter with the options of another."""
    name = next(name for name, seed in SEEDS.items() if seed == pf.options.seed)
    return FILTERS[name](pf.device.selection)


SEEDS = {name: make("numpy").options.seed for name, make in FILTERS.items()}


class Interrupted:
    """One call of one filter."""

    def __init__(self, name: str, backend: str, call: str) -> None:
        self._make, self._call = (lambda: FILTERS[name](backend)), CALLS[call]
        everywhere = name == "sensors, resetting"
        pf = begun(self._make(), 4 if everywhere else 3, everywhere=everywhere)
        self._start, self.pf = pf.state(), pf
        self._prepare()
        self._before = everything(pf)
        self._prepare()
        self._call(pf)
        self._after = everything(pf)
        assert (self._after == self._before) == (call in LOOKS)

    def _prepare(self) -> None:
        """Give the filter a postponed motion."""
        self.pf.restore(self._start)
        self.pf.predict(*odometry(3))

    def lines(self) -> list[Line]:
        """Return the lines of the call in a steady state."""
        self._prepare()
        lines = executed_lines(lambda: self._call(self.pf))
        return [line for line in lines if any(f"/gpusense/{room}/" in line[0].co_filename for room in ROOMS)]

    def check(self, line: Line) -> bool:
        """Interrupt the call at a line, and repeat it if it has changed nothing."""
        self._prepare()
        assert everything(self.pf) == self._before
        self._prepare()
        interrupted = interrupt(lambda: self._call(self.pf), line)
        found = everything(self.pf)
        assert found in (self._before, self._after), line
        if found == self._before != self._after or not interrupted:
            self._call(self.pf)
            assert not interrupted or everything(self.pf) == self._after, line
        return interrupted


def interrupt_lines(name: str, backend: str, call: str, most: int | None) -> None:
    """Interrupt a call at all lines, or at a limited number that differ by filter and call."""
    case = Interrupted(name, backend, call)
    lines = case.lines()
    every = 1 if most is None else max(len(lines) // most, 1)
    lines = lines[(3 * list(FILTERS).index(name) + list(CALLS).index(call)) % every :: every]
    reached = sum(case.check(line) for line in lines)
    # Only first calls reach lines that make and record programs.
    assert reached > 0.7 * len(lines) > 0, (reached, len(lines))


some_lines = pytest.mark.parametrize("most", [7, pytest.param(None, marks=pytest.mark.slow)], ids=["some", "all"])


@pytest.mark.sampled(0.4)
@some_lines
@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("name", FILTERS)
def test_a_call_that_was_interrupted_has_changed_all_or_nothing(name, call, most):
    interrupt_lines(name, "numpy", call, most)


@some_lines
def test_a_correction_on_a_device_that_was_interrupted_has_changed_all_or_nothing(most, device):
    interrupt_lines("field", device.info.selection, "correct", most)


@some_lines
def test_a_recorded_step_that_was_interrupted_has_changed_all_or_nothing(warp_as_gpu, most):
    interrupt_lines("field", "warp:cpu", "correct", most)


def test_readings_that_a_model_refuses_change_nothing(backend):
    pf = begun(FILTERS["sensors, resetting"](backend))
    pf.predict(*odometry(3))
    before = everything(pf)
    with pytest.raises(ValueError, match="heading"):
        # The scan is scored before.
        pf.correct({pf.models[0]: readings(pf, 3)[pf.models[0]], pf.models[1]: np.zeros((2, 2))})
    assert everything(pf) == before


class FailingError(Exception):
    """An error of a model."""


def fail_in_every_call(name: str, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each call of a correction that scores fail in turn: of models, or on GPUs the start of a recorded step."""
    pf = begun(FILTERS[name](backend))
    pf.predict(*odometry(3))
    start, before = pf.state(), everything(pf)
    pf.correct(readings(pf, 3))
    after, count = everything(pf), [0]
    owners = [(one, call) for one in pf.models for call in ("start_scoring", "log_likelihood") if hasattr(one, call)]
    exchanges = [(kind, "start") for kind in (Exchange, *Exchange.__subclasses__()) if "start" in vars(kind)]
    for owner, call in (*owners, *exchanges):
        inner = getattr(owner, call)

        def failing(*arguments, inner=inner, **options):
            count[0] -= 1
            if count[0] == 0:
                raise FailingError
            return inner(*arguments, **options)

        monkeypatch.setattr(owner, call, failing)
    for fails in range(1, 20):
        pf.restore(start)
        count[0] = fails
        try:
            pf.correct(readings(pf, 3))
        except FailingError:
            assert everything(pf) == before
            pf.correct(readings(pf, 3))
        else:
            assert fails > 1
            break
        finally:
            count[0] = 0
        assert everything(pf) == after
    else:
        pytest.fail("no correction without the failure")


@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("name", FILTERS)
def test_a_model_that_fails_in_any_call_changes_nothing(name, backend, monkeypatch):
    fail_in_every_call(name, backend, monkeypatch)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", FILTERS)
def test_a_recorded_step_that_fails_in_any_call_changes_nothing(name, device, monkeypatch):
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1, vector_loops=False))
    fail_in_every_call(name, device.info.selection, monkeypatch)


@pytest.mark.parametrize("late", ["corrected", "begin_lesson", "work"])
def test_a_repeated_correction_learns_from_the_same_lesson(backend, monkeypatch, late):
    """The interrupted correction has begun its lesson, or has started the last one in the buffers of an earlier one."""
    owners = {"corrected": rival.Recovery, "begin_lesson": sensors.Sensor, "work": lessons.Learner}
    owner = owners[late]
    inner, fails = getattr(owner, late), [False]

    def failing(*arguments, **options):
        if late != "corrected":
            inner(*arguments, **options)
        if fails[0]:
            raise KeyboardInterrupt
        if late == "corrected":
            inner(*arguments)

    monkeypatch.setattr(owner, late, failing)
    found = []
    for interrupted in (False, True):
        pf = begun(FILTERS["field"](backend), 4)
        pf.predict(*odometry(4))
        fails[0] = interrupted
        if interrupted:
            with pytest.raises(KeyboardInterrupt):
                pf.correct(readings(pf, 4))
        fails[0] = False
        pf.correct(readings(pf, 4))
        found.append(everything(pf))
    assert found[0] == found[1]


def test_an_interrupt_of_the_way_back_is_made_good_by_the_next_call(monkeypatch):
    """A second Ctrl-C comes while the first one is handled."""
    pf = begun(FILTERS["field"]("numpy"))
    pf.predict(*odometry(3))
    before, restore = everything(pf), journal.Journal.restore

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(journal.Journal, "restore", interrupted)
    monkeypatch.setattr(type(pf._parts.verdict), "corrected", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pf.correct(readings(pf, 3))
    monkeypatch.setattr(journal.Journal, "restore", restore)
    assert pf.count == 200 and pf.state().step == 5 and everything(pf) == before


def test_calls_of_threads_wait_for_one_another():
    pf = begun(gs.ParticleFilter(field("numpy"), particles=300, seed=1))
    wrong: list[object] = []

    def read() -> None:
        for _ in range(30):
            if not np.isfinite(pf.estimate().pose).all() or abs(pf.host_weights().sum() - 1) > 1e-9:
                wrong.append(pf)

    threads = [threading.Thread(target=read) for _ in range(3)]
    for each in threads:
        each.start()
    for step in range(3, 12):
        pf.predict(*odometry(step))
        pf.correct(readings(pf, step))
    for each in threads:
        each.join()
    assert not wrong
