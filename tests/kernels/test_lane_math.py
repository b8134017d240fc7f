"""Functions of lanes/math in OpenCL and Warp against more digits, in ulps, and the source of their constants."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy import special

from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.interface.kernel_files import warp_files
from gpusense.interface.signatures import LANES
from gpusense.interface.sources import assemble

NORMAL = float(np.finfo(np.float32).tiny)
COUNT = 1 << 22


def spread(low: float, high: float) -> np.ndarray:
    """Return positive float32 numbers from low to high, inclusive, evenly by bits and by value."""
    ends = np.array([low, high], np.float32)
    bits = np.linspace(*ends.view(np.int32).astype(np.float64), COUNT // 2).astype(np.int32).view(np.float32)
    return np.concatenate([bits, np.linspace(*ends, COUNT // 2, dtype=np.float32)])


# Arguments, and the function in float64.
FUNCTIONS = {
    "exp_lanes": (-spread(1e-30, 87.0), np.exp),
    "one_minus_exp_lanes": (-spread(1e-36, 200.0), lambda a: -np.expm1(a)),
    "log_lanes": (np.concatenate([spread(NORMAL, 3e38), spread(0.5, 2.0)]), np.log),
    "erf_lanes": (spread(1e-36, 6.0), special.erf),
}


@pytest.fixture
def evaluate(needs):
    """Return a function that evaluates a function of the file at every number of an array, on the OpenCL device."""
    selection = needs("opencl")
    import pyopencl as cl

    from gpusense.backends import get_backend

    backend = get_backend(selection)
    context = backend._context
    queue = cl.CommandQueue(context)

    def run(function: str, numbers: np.ndarray) -> np.ndarray:
        double = numbers.dtype == np.float64
        if double and not backend.info.float64:
            pytest.skip(f"{backend.info.name} has no float64")
        flags, lanes = frozenset({"FLOAT64"} if double else ()), LANES // 2 if double else LANES
        kernel = (
            "kernel void each(global const real *in, global real *out) {\n"
            f"    store_lanes({function}(load_lanes(get_global_id(0), in)), get_global_id(0), out);\n}}\n"
        )
        program = backend.programs.built(cl.Program(context, assemble("lanes/math", flags) + kernel))
        given = cl.Buffer(context, cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR, hostbuf=numbers)
        made, found = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, numbers.nbytes), np.empty_like(numbers)
        program.each(queue, (len(numbers) // lanes,), None, given, made)
        cl.enqueue_copy(queue, found, made)
        return found

    return run


@pytest.fixture
def evaluate_warp(needs):
    """Return a function that evaluates a function of Warp's file at every number of an array, on the processor."""
    needs("warp")
    import warp as wp

    lanes = warp_files().file_of("lanes.math")
    exp, one_minus_exp, log, erf = (getattr(lanes, name) for name in FUNCTIONS)

    def each(given, found):
        i = wp.tid()
        found[0, i] = exp(given[i])
        found[1, i] = one_minus_exp(given[i])
        found[2, i] = log(given[i])
        found[3, i] = erf(given[i])

    each.__annotations__ = dict(given=wp.array(dtype=wp.float32), found=wp.array2d(dtype=wp.float32))
    kernel = wp.kernel(module="unique", enable_backward=False, module_options=dict(fuse_fp=False))(each)

    def run(function: str, numbers: np.ndarray) -> np.ndarray:
        found = wp.empty((len(FUNCTIONS), len(numbers)), dtype=wp.float32, device="cpu")
        wp.launch(kernel, len(numbers), [wp.array(numbers, dtype=wp.float32, device="cpu"), found], device="cpu")
        return found.numpy()[list(FUNCTIONS).index(function)]

    return run


@pytest.fixture(params=["opencl", "warp"])
def in_either(request):
    """Return ``evaluate`` or ``evaluate_warp``."""
    return request.getfixturevalue("evaluate" if request.param == "opencl" else "evaluate_warp")


@pytest.mark.long
@pytest.mark.parametrize("function", FUNCTIONS)
def test_errors_in_ulps(function, in_either):
    numbers, exact = FUNCTIONS[function]
    truth = exact(numbers.astype(np.float64))
    ulp = np.spacing(np.abs(truth).astype(np.float32)).astype(np.float64)
    off = np.abs(in_either(function, numbers) - truth) / ulp
    worst = int(np.argmax(off))
    print(f"{function}: {off[worst]:.3f} ulp at {numbers[worst]!r}")
    row = "erf in lanes" if function == "erf_lanes" else "exp, 1 - exp and log in lanes"
    assert off[worst] <= TOLERANCES[row].value


def test_one_minus_exp_of_float64_is_within_5_ulp(evaluate):
    a = -np.concatenate([np.geomspace(1e-30, 40.0, 3000), np.linspace(0.2, 0.3, 1000)])
    found = evaluate("one_minus_exp_lanes", a)
    with mp.workdps(40):
        exact = [-mp.expm1(mp.mpf(each)) for each in a.tolist()]
        off = [
            abs(float((mp.mpf(one) - truth) / mp.mpf(np.spacing(float(truth)))))
            for one, truth in zip(found.tolist(), exact, strict=True)
        ]
    print(f"one_minus_exp_lanes: {max(off):.3f} ulp at {a[int(np.argmax(off))]!r}")
    assert max(off) <= 5
    assert evaluate("one_minus_exp_lanes", np.resize([0.0, -800.0, -np.inf], LANES // 2))[:3].tolist() == [0, 1, 1]


def test_arc_rest_is_below_a_fifth_of_the_last_bit(evaluate):
    """Check the difference arctan t - t, in ulps of arctan t."""
    t = spread(1e-30, 0.41421356)
    exact = np.arctan(t.astype(np.float64))
    off = np.abs(evaluate("arc_rest_lanes", t) - (exact - t)) / np.spacing(exact.astype(np.float32))
    print(f"arc_rest_lanes: {off.max():.3f} ulp at {t[int(np.argmax(off))]!r}")
    assert off.max() <= 0.2


def test_the_log_of_erfc_is_within_two_eps(evaluate):
    """Errors are in eps (1 + |log(erfc(x) / 2)|), the size of the terms of a bumper."""
    x = spread(1e-30, 4.0)
    exact = np.log(special.erfc(x.astype(np.float64)))
    off = np.abs(evaluate("log_erfc_lanes", x) - exact) / (1 + np.log(2) - exact) / np.finfo(np.float32).eps
    print(f"log_erfc_lanes: {off.max():.3f} eps at {x[int(np.argmax(off))]!r}")
    assert off.max() <= 2


def test_ends(in_either):
    """Check exact values, far arguments, and independence of neighbours."""

    def at(function: str, *numbers: float) -> list[float]:
        given = np.resize(np.array(numbers, np.float32), LANES)
        alone = [in_either(function, np.full(LANES, number, np.float32))[0] for number in given[: len(numbers)]]
        together = in_either(function, given)[: len(numbers)].tolist()
        assert together == [float(value) for value in alone]
        return together

    assert at("exp_lanes", 0.0, -0.0, -88.0, -1e9, -3e38, -np.inf) == [1, 1, 0, 0, 0, 0]
    assert at("one_minus_exp_lanes", 0.0, -20.0, -1e9, -np.inf) == [0, 1, 1, 1]
    assert at("log_lanes", 1.0) == [0]
    assert at("erf_lanes", 0.0, 4.0, 1e9, np.inf) == [0, 1, 1, 1]
