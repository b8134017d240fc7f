"""The calling thread polls for the end of short launches of PoCL."""

from __future__ import annotations

import numpy as np
from support.matching_scenes import RING, random_pairs

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.opencl import backend as of_backend
from gpusense.backends.opencl.launch import watch


class Event:
    """An event that ends after some polls."""

    def __init__(self, looks: float) -> None:
        self.looks = looks

    @property
    def command_execution_status(self) -> int:
        self.looks -= 1
        return 1 if self.looks > 0 else 0


def test_a_launch_is_watched_until_it_ends_but_not_long():
    short, endless = Event(3), Event(np.inf)
    watch(short)
    assert short.looks == 0
    watch(endless)


def test_launches_are_watched_that_leave_a_processor(needs, monkeypatch):
    needs("opencl")
    # Only PoCL's launches are watched, so this needs PoCL.
    device, watched = get_backend("opencl:pocl"), []
    monkeypatch.setattr(of_backend, "watch", lambda event: (watched.append(event), watch(event)))
    first, second, guess = (values[0] for values in random_pairs(1, RING, seed=3))
    results = []
    for most in (1, 0):
        monkeypatch.setattr(device, "_most_watched", most)
        watched.clear()
        results.append(gs.match_scan(first, second, RING, guess, backend=device))
        assert bool(watched) == bool(most) and device._last is None
    assert results[0].pose.tolist() == results[1].pose.tolist()
