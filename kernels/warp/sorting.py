"""Sort short lists of numbers."""

import warp as wp


@wp.func
def sort_numbers(number: wp.array(dtype=wp.float64), first: wp.int32, count: wp.int32, to: wp.int32):
    """Write count numbers from first on in ascending order, from to on."""
    for i in range(count):
        mine = number[first + i]
        before = int(0)
        for j in range(count):
            other = number[first + j]
            if other < mine or (other == mine and j < i):
                before += 1
        number[to + before] = mine
