"""The choice of a method for an error or a time, by hand."""

from __future__ import annotations

import dataclasses
import math
import random

import numpy as np
import pytest
from support.bench_world import made_point, made_report

from gpusense._util.documents import plain
from gpusense.evaluation.benchmark import choice, report


def test_pareto_front_by_hand():
    #           slow, exact  beaten      fast       equal to 2  slower      fastest, rough
    points = [(0.0, 9.0), (1.0, 9.5), (1.0, 4.0), (1.0, 4.0), (2.0, 4.0), (3.0, 1.0)]
    assert choice.pareto_front(points) == [0, 2, 5]
    assert choice.pareto_front([]) == []


def test_numbers_of_a_report_are_json():
    value = {"a": (np.float64(1 / 3), math.inf), "b": {"c": math.nan, "d": None, "e": True}}
    assert plain(value, 6) == {"a": [0.333333, None], "b": {"c": None, "d": None, "e": True}}


def entry(method, error, seconds, setting="", precision="float32", **changes):
    errors, units = {"e": error}, {"e": "m"}
    quartiles = (seconds,) * 3
    return report.Row(
        "rays", "d", report.ALL, method, setting, precision, "", seconds, quartiles, errors, units, **changes
    )


def choose(rows, *limits):
    return choice.choose(rows, "e", *limits)


LISTED = [
    entry("model itself", 1e-9, 4.0, exact=True), entry("as exact, slower", 0.0, 5.0),
    entry("little off, twice varied, once", 0.004, 1.1), entry("little off, varied", 0.003, 1.2),
    entry("rough", 0.5, 0.2), entry("beaten", 0.6, 0.9),
]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "seconds", "chosen"),
    [
        (1e-5, None, "model itself"),
        # Equally fast: fewer assumptions win.
        (0.01, None, "little off, varied"),
        (0.01, 1.15, "little off, twice varied, once"),
        (1.0, None, "rough"),
        (None, 4.5, "model itself"),
        (None, 1.0, "rough"),
        (None, 0.1, None),
        (0.001, 3.0, None),
    ],
)
def test_choice_by_hand(error, seconds, chosen):
    found = choose(LISTED, error, seconds)
    assert (found and found.method) == chosen


def test_front_by_hand():
    """Rounding errors do not count: the slower of two exact methods is beaten."""
    names = [one.method for one in choice.front(LISTED, "e")]
    assert names == ["model itself", "little off, varied", "little off, twice varied, once", "rough"]


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_other_days_changes_no_choice(seed):
    """Change all times by up to a tenth: the methods stay the same for any limit."""
    draw = random.Random(seed)
    noisy = [dataclasses.replace(each, seconds=each.seconds * draw.uniform(0.9, 1.1)) for each in LISTED]
    for error, seconds in ((1e-5, None), (0.01, None), (1.0, None), (None, 10.0), (None, 2.0), (None, 0.5)):
        assert choose(noisy, error, seconds).method == choose(LISTED, error, seconds).method


def test_of_equal_methods_nothing_measured_decides():
    """Errors and times within a quarter: exact, float32, few assumptions, a default, the name, the coarsest setting."""
    order = [
        ("exact", "", "float32"), ("beam", "100 x 8", "float32"), ("beam", "100 x 60", "float32"),
        ("discrete", "100 x 8", "float32"), ("beam, cddt", "100 x 8", "float32"),
        ("exact, fewer beams", "every = 12", "float32"), ("exact, fewer beams", "every = 2", "float32"),
        ("beam", "100 x 8", "float64"),
    ]  # fmt: skip
    draw = random.Random(0)
    listed = [
        entry(one[0], draw.uniform(0.1, 0.12), draw.uniform(1, 1.2), *one[1:], exact=one[0] == "exact") for one in order
    ]
    for first in range(len(listed)):
        rest = draw.sample(listed[first:], len(listed) - first)
        for limits in ((1.0, None), (None, 9.0)):
            assert choose(rest, *limits) == listed[first]


@pytest.mark.parametrize(
    ("error", "seconds", "changes", "stands"),
    [
        # Up to 1.5 times the fastest and the most exact method, but not beyond, nor beyond a limit.
        (1.0, None, {"seconds": 1.5}, True), (1.0, None, {"seconds": 1.6}, False),
        (None, 9.0, {"error": 0.15}, True), (None, 9.0, {"error": 0.16}, False), (None, 9.0, {"seconds": 1.6}, False),
        (0.2, None, {"error": 0.19, "doubt": 1.2}, True), (0.2, None, {"error": 0.21}, False),
        (None, 1.4, {"seconds": 1.5}, False),
    ],
)  # fmt: skip
def test_an_earlier_choice_stands_until_another_method_is_clearly_better(error, seconds, changes, stands):
    best, earlier = entry("a", 0.1, 1.0), entry("z", **({"error": 0.1, "seconds": 1.0} | changes))
    assert choose([best, earlier], error, seconds) == best
    assert choose([best, earlier], error, seconds, earlier) == (earlier if stands else best)
    assert choose([best], error, seconds, earlier) == best


def test_an_error_keeps_its_limit_for_other_seeds():
    sure, doubtful = entry("b", 0.019, 2.0), entry("a", 0.017, 1.0, doubt=1.2)
    assert choose([sure, doubtful], 0.02, None) == sure and choose([doubtful], 0.021, None) == doubtful
    assert choose([doubtful], 0.02, None) is None


def test_a_method_is_judged_by_its_worst_scene_and_must_work_in_all():
    kl, known = {"kl": 0.0}, {"problem": "beam", "cloud": "tracking"}
    points = [
        made_point(**known, comparable=kl, call_min_s=1.0),
        made_point(**known, scene="t", comparable={"kl": 0.3}, call_min_s=4.0),
        made_point(**known, method="dda", comparable=kl),
        made_point(**known, method="dda", scene="t", status="failed", errors=None, time=None),
    ]
    made = made_report() | {"points": points, "command": "", "date": "", "commit": ""}
    ((_, answer, _),) = choice.choices(made, {"nats": 0.1})
    assert answer == "beam model on numpy, 10 x 10, error at most 0.1 nats: no method"
    late = made_point(**known, status="left out", reason="the 40 s of this run were over", errors=None, time=None)
    ((_, answer, _),) = choice.choices(made | {"points": [late]}, {"nats": 0.1})
    assert answer.endswith("error at most 0.1 nats: not measured: the 40 s of this run were over")
    ((_, answer, rows),) = choice.choices(made, {"nats": 0.4}, 3.0)
    assert answer == "beam model on numpy, 10 x 10, error at most 0.4 nats, at most 3 s: exact: 2 s, 0.3 nats"
    assert rows == [("beam model", "exact", "0.3 nats", "2 s")]


def test_values_are_read_with_units():
    values = ((0.0123, "share"), (0.0123, "m"), (0.0042, "m"), (3e-9, "nats"), (0.5, "cells"))
    assert [choice.error_text(*one) for one in values] == ["1.2 %", "1.23 cm", "4.2 mm", "0 nats", "0.5 cells"]
    assert [choice.time_text(s) for s in (1.5e-5, 0.0042, 2.0)] == ["15 us", "4.2 ms", "2 s"]
