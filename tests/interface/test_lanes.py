"""Teams of work-items by the points of an item and the groups of a GPU."""

from __future__ import annotations

import pytest

from gpusense.interface.lanes import with_teams_flags


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
