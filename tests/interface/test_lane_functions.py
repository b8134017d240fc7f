"""Text of scalar functions with vectors instead of numbers, and the work-items of teams."""

from __future__ import annotations

import pytest

from gpusense.interface.lanes import with_teams_flags, written_in_lanes
from gpusense.interface.sources import assemble, relevant


@pytest.mark.parametrize(
    ("points", "limit", "team"),
    [(1, 1024, 32), (64, 1024, 32), (65, 1024, 256), (512, 256, 256), (513, 256, 256), (9000, 255, 32), (9000, 31, 1)],
)
def test_a_team_has_a_work_item_for_every_two_points_where_groups_hold_it(points, limit, team):
    flags, found = with_teams_flags("gpu", "match_scans", frozenset({"FLOAT64"}), points, lambda kernel, flags: limit)
    assert found == team
    teams = {1: set(), 32: {"IN_TEAMS", "SMALL_TEAMS"}, 256: {"IN_TEAMS"}}
    assert flags == {"FLOAT64", *teams[team]}


def test_processors_have_no_teams():
    flags = frozenset({"FLOAT64"})
    assert with_teams_flags("cpu", "match_scans", flags, 9000, lambda kernel, flags: 1024) == (flags, 1)


SCALAR = """\
#define STEP 2
// A pair.
typedef struct {
    int count;
} Other;

typedef struct {
    long whole;
    double2 rest;
} Turn;

// Return the sum.
real2 two_sum(const real a, const real b) {
    const real sum = a + b;
    return (real2)(sum, (a - (sum - b)) + f(a, (b)));
}

integer is_below(const integer i, const int last) { return i < last; }

real twice(const real a) { return exp(two_sum(a, a).x) + a; }

Turn turn_of(const double x, global const double *settings, const int kind) {
    Turn turn;
    turn.rest = (double2)(settings[STEP] * x, x);
    return turn;
}
"""
TYPES = "lanes exp_lanes(const lanes a) { return a; }\nlanes sum_lanes(const lanes a) { return a; }\n"


def lanes_of(names: str, head: str = "") -> str:
    return written_in_lanes(f"{head}// in lanes: {names}\nlast\n", "lanes/one", {"one": SCALAR, "lanes/types": TYPES})


def test_numbers_become_vectors():
    assert lanes_of("two_sum") == (
        '#line 13 "one.cl"\n'
        "LanePair two_sum_lanes(const lanes a, const lanes b) {\n"
        "    const lanes sum = a + b;\n"
        "    return (LanePair){sum, (a - (sum - b)) + f(a, (b))};\n"
        "}\n"
        '#line 2 "lanes/one.cl"\nlast\n'
    )


def test_calls_are_those_of_functions_in_lanes():
    line = "lanes twice_lanes(const lanes a) { return exp_lanes(two_sum_lanes(a, a)"
    assert f"{line}.x) + a; }}\n" in lanes_of("two_sum twice")
    alone = lanes_of("twice", "lanes unrelated(const lanes a) { return a; }\n")
    assert "exp_lanes(two_sum(a, a).x)" in alone
    assert alone.startswith("lanes unrelated") and '#line 3 "lanes/one.cl"' in alone


def test_integers_of_lanes_are_named_so():
    assert "ilanes is_below_lanes(const ilanes i, const int last) { return i < last; }" in lanes_of("is_below")


def test_structs_become_structs_and_memory_stays():
    text = lanes_of("STEP Turn turn_of")
    assert '#line 1 "one.cl"\n#define STEP 2\n' in text
    assert "typedef struct {\n    long8 whole;\n    DoublePair rest;\n} Turn_lanes;\n" in text
    assert "Turn_lanes turn_of_lanes(const doubles x, global const double *settings, const int kind) {" in text
    assert "turn.rest = (DoublePair){settings[STEP] * x, x};" in text


@pytest.mark.parametrize("name", ["none", "STEPS", "Pair"])
def test_a_name_without_a_text_is_refused(name):
    with pytest.raises(ValueError, match=rf"^lanes/one\.cl: .* scalar file, got '{name}'$"):
        lanes_of(name)


def test_a_kernel_keeps_its_name_and_numbers():
    text = assemble("weighing", frozenset({"IN_LANES"}))
    kernel = text[text.index("kernel void set_weights(") :]
    assert "double sum = sum_before(" in kernel
    assert "eight_at_lanes(score, n, end, -INFINITY)" in kernel


def test_flags_of_the_scalar_text_belong_to_the_program():
    flags = frozenset({"IN_LANES", "RAND"})
    assert relevant("motion", flags) == {"IN_LANES"}
    assert relevant("absolute", flags) == flags
