"""Small scenes, plans, candidates and reports for the tests of ``gpusense bench``."""

from __future__ import annotations

import copy

import numpy as np

from gpusense.backends import get_backend
from gpusense.evaluation.benchmark import candidates, report, runner, scenes

TIMES = {"first_s", "call_min_s", "call_q1_s", "call_median_s", "call_q3_s", "processor_s", "calls"}
ERRORS = {
    "ranges": {"median", "p95", "max", "wrong_1"},
    "log_p": {"max", "rms"},
    "comparable": {"kl", "shift_m"},
}


def quick_scene(name="clutter", **changes):
    (source,) = scenes.sources([name], quick=True)
    arguments = {"beams": 9, "particles": 20, "seed": 3} | changes
    return scenes.make_scene(source, get_backend("numpy"), **arguments)


def plan_of(*chosen, **changes):
    values = {
        "sources": scenes.sources(["clutter"], quick=True), "backends": [get_backend("numpy")], "candidates": chosen,
        "precisions": ("float32",), "particles": 8, "checked": 6, "beams": 7, "repeats": 2,
    }  # fmt: skip
    return runner.Plan(**(values | changes))


def candidate(run, problem="ranges", **changes):
    """Return a candidate whose runner calls ``run(scene, poses)``."""

    def make(scene, backend, precision):
        return lambda poses: run(scene, poses)

    return candidates.Candidate(problem, "made up", make, **changes)


def free_ranges(scene, poses):
    return np.full((len(poses), scene.scanner.count), scene.scanner.range_max)


def made_point(**changes):
    """Return a point of a report."""
    point = {
        "scene": "s", "cloud": "global", "problem": "ranges", "backend": "numpy", "device": "d", "kind": "cpu",
        "method": "exact", "variant": "", "knob": "", "value": None, "code": "", "precision": "float32", "exact": False,
        "outside": False, "particles": 10, "beams": 10, "work": 100, "checked": 5, "status": "ok", "reason": "",
        "time": dict.fromkeys(TIMES, 1.0) | {"calls": 20},
        "errors": {kind: dict.fromkeys(names, 0.5) for kind, names in ERRORS.items()},
    }  # fmt: skip
    point = copy.deepcopy(point)
    for name, value in changes.items():
        for kind in ("time", "errors"):
            if isinstance(point.get(kind), dict) and name in point[kind]:
                point[kind][name] = value
                break
        else:
            point[name] = value
    return point


def wrong(share):
    return dict.fromkeys(ERRORS["ranges"], 0.0) | {"wrong_1": share}


def made_report(**changes):
    point = made_point(**changes)
    return {
        "schema": report.SCHEMA, "arguments": {}, "machine": {"processor": "p"}, "points": [point],
        "scenes": [{"name": "s", "fingerprint": "f"}],
    }  # fmt: skip
