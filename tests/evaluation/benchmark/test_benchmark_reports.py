"""Reports of ``gpusense bench``: the Pareto front and numbers by hand."""

from __future__ import annotations

import json
import math

import numpy as np

from gpusense.evaluation.benchmark import choice, report


def test_pareto_front_by_hand():
    #           slow, exact  beaten      fast       equal to 2  slower      fastest, rough
    points = [(0.0, 9.0), (1.0, 9.5), (1.0, 4.0), (1.0, 4.0), (2.0, 4.0), (3.0, 1.0)]
    assert choice.pareto_front(points) == [0, 2, 5]
    assert choice.pareto_front([]) == []


def test_numbers_of_a_report_are_json():
    value = {"a": (np.float64(1 / 3), math.inf), "b": {"c": math.nan, "d": None, "e": True}}
    assert report.plain(value) == {"a": [0.333333, None], "b": {"c": None, "d": None, "e": True}}
    assert json.loads(report.to_json({"x": [1, 2], "y": {"z": "é"}, "w": []})) == {
        "x": [1, 2],
        "y": {"z": "é"},
        "w": [],
    }
