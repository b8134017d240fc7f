"""The pace of the nodes: the queue of scans, rests after costly work, and lost messages."""

from __future__ import annotations

from typing import Any

import pytest

from gpusense.logs.transform_buffer import TransformError
from gpusense.ros.pacing import Losses, Rest, ScanQueue


@pytest.fixture
def queued() -> Any:
    """Return a queue over scans that are their times, its clock, its known transforms and what it delivered."""
    now, known, out = [0.0], set(), []

    def look_up(scan: int) -> str:
        if scan not in known:
            raise TransformError(f"none at {scan}", early=scan > max(known, default=0))
        return f"t{scan}"

    return ScanQueue(look_up, lambda *pair: out.append(pair), most=3, clock=lambda: now[0]), now, known, out


def test_scans_are_delivered_in_their_order(queued: Any) -> None:
    queue, _, known, out = queued
    for scan in (1, 2, 3):
        queue.add(scan, scan)
    known |= {1, 2, 3}
    queue.check()
    assert out == [(1, "t1"), (2, "t2"), (3, "t3")] and queue.dropped == 0


def test_a_scan_from_before_the_transforms_is_dropped(queued: Any) -> None:
    queue, _, known, out = queued
    queue.add(1, 1)
    known |= {2}
    queue.add(2, 2)
    assert out == [(2, "t2")] and queue.dropped == 1 and queue.reason == "the transforms begin after the scan"


def test_patience_and_length(queued: Any) -> None:
    queue, now, known, out = queued
    for scan in range(5):
        now[0] = 0.3 * scan
        queue.add(scan, scan)
    assert len(queue) == 3 and queue.dropped == 2 and "more than 3" in queue.reason
    now[0] = 1.61
    queue.check()
    assert len(queue) == 2 and queue.dropped == 3 and queue.reason == "no transform within 1 s: none at 2"
    queue.clear()
    queue.add(5, 5)
    now[0] = 100.0  # a busy node reads what came before it drops scans
    queue.check()
    known |= {3, 4, 5}
    queue.check()
    assert out == [(5, "t5")]


def test_scans_whose_stamps_go_back_replace_later_ones(queued: Any) -> None:
    queue, _, known, out = queued
    queue.add(1000, 1000)
    queue.add(5, 5)
    assert len(queue) == 1 and queue.dropped == 1 and queue.reason == "the stamps of scans went back"
    known |= {5}
    queue.check()
    assert out == [(5, "t5")]


def test_a_callback_of_the_node_delivers_for_a_fourth_of_a_second(queued: Any) -> None:
    _, now, known, out = queued

    def deliver(scan: int, transforms: str) -> None:
        now[0] += 0.1
        out.append((scan, transforms))

    queue = ScanQueue(lambda scan: f"t{scan}" if scan in known else missing(), deliver, clock=lambda: now[0])
    for scan in range(8):
        queue.add(scan, scan)
    known |= set(range(8))
    for count in (3, 6, 8):
        queue.check()
        assert [scan for scan, _ in out] == list(range(count))
    assert queue.dropped == 0 and len(queue) == 0


def missing() -> None:
    raise TransformError("none", early=True)


def test_each_check_asks_for_few_transforms_while_a_frame_is_unknown() -> None:
    """Otherwise each message on /tf costs as many look-ups as scans wait."""
    asked, is_known, out = [], [False], []

    def look_up(scan: int) -> int:
        asked.append(scan)
        if not is_known[0]:
            raise TransformError("no transform names laser")
        return scan

    queue = ScanQueue(look_up, lambda scan, _: out.append(scan))
    for scan in range(100):
        queue.add(scan, scan)
    assert len(asked) <= 200
    is_known[0] = True
    queue.check()
    assert out == list(range(100)) and queue.dropped == 0


def test_a_delivery_that_fails_loses_its_scan_alone(queued: Any) -> None:
    _, now, known, out = queued

    def deliver(scan: int, transforms: str) -> None:
        now[0] += 10.0
        if scan == 1:
            raise MemoryError
        out.append(scan)

    queue = ScanQueue(lambda scan: f"t{scan}" if scan in known else missing(), deliver, clock=lambda: now[0])
    for scan in (1, 2):
        queue.add(scan, scan)
    known |= {1, 2}
    with pytest.raises(MemoryError):
        queue.check()
    queue.check()
    assert out == [2] and queue.dropped == 0


# ------------------------------------------------------------------------------------------------ rests and losses


def test_costly_work_takes_a_tenth_of_the_time() -> None:
    now, busy = [0.0], 0.0
    rest = Rest(lambda: now[0])
    while now[0] < 1000.0:
        if rest.over:
            with rest.after():
                now[0] += 0.7
                busy += 0.7
        now[0] += 0.05
    assert 60.0 < busy < 100.0


def test_work_that_fails_rests_too() -> None:
    now = [0.0]
    rest = Rest(lambda: now[0])
    with pytest.raises(MemoryError), rest.after():
        now[0] = 1.0
        raise MemoryError
    now[0] = 10.9
    assert not rest.over
    now[0] = 11.0
    assert rest.over


@pytest.mark.parametrize("numbers, lost", [
    ([5, 6, 7], 0), ([5, 9], 3), ([5, 9, 10, 20], 12), ([500, 1, 2, 4], 1), ([1, 20_000], 0),
    # Two publishers, in turn and with losses; one that starts anew.
    ([1000, 10, 1001, 11, 1002, 12], 0), ([1000, 10, 1001, 13, 1005], 5), ([7, 7, 8, 8, 9, 9], 0),
    ([1000, 10, 1001, 11, 1, 12, 2, 1002, 13], 0), ([None, None, 2**64 - 1, 2**64 - 1], 0),
])  # fmt: skip
def test_numbers_of_publications_show_losses(numbers: list[int | None], lost: int) -> None:
    losses = Losses()
    assert sum(map(losses.take, numbers)) == lost
