"""The gradient of the interpolated likelihood field against Warp's tape through the kernel's functions."""

from types import SimpleNamespace

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.interface.kernel_files import warp_module
from gpusense.interface.signatures import KERNELS

YAW = 0.7
SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.1, count=40, range_max=6.0, mount=(0.3, -0.1, 0.4))
KINDS = {"linear": {}, "sharp": dict(z_hit=1.0, z_rand=0.0, sigma_hit=1e-3)}


def tape_kernel(wp, flags):
    """Make a kernel that adds the term of a reading to log p, with functions of the field's kernels.

    A change of the pose (x, y [m], theta) is its differentiable input.
    """
    prelude, end_point, field_term = (warp_module(name) for name in ("prelude", "end_point", "field_term"))
    of_field = field_term.functions(flags)
    place, bilinear, log_field = end_point.functions(flags).end_point, of_field.bilinear, of_field.log_field
    types, options = prelude.precision(flags), prelude.OPTIONS | {"enable_backward": True}
    Window, HALF = types.Window, wp.float64(0.5)

    @wp.kernel(module="unique", enable_backward=True, module_options=options)
    def add_terms(
        change: wp.array(dtype=wp.vec3d),
        table: wp.array(dtype=wp.float64),
        pose_cell: wp.array(dtype=wp.vec2i),
        pose: wp.array(dtype=wp.vec4d),
        point: wp.array(dtype=wp.vec2d),
        terms: wp.array(dtype=types.FieldTerms),
        log_p: wp.array(dtype=wp.float64),
        window: Window,
        guard: wp.float64,
        mount: wp.vec2d,
        resolution: wp.float64,
    ):
        n, k = wp.tid()
        at, by = pose[n], change[n]
        c = at[2] * wp.cos(by[2]) - at[3] * wp.sin(by[2])
        s = at[3] * wp.cos(by[2]) + at[2] * wp.sin(by[2])
        x = at[0] + by[0] / resolution + (c - at[2]) * mount[0] - (s - at[3]) * mount[1]
        y = at[1] + by[1] / resolution + (s - at[3]) * mount[0] + (c - at[2]) * mount[1]
        end = place(wp.vec4d(x, y, c, s), wp.vec4d(), point[k], wp.vec2d(), HALF, guard)
        wp.atomic_add(log_p, n, log_field(bilinear(table, pose_cell[n] + end.cell, end, window), terms))

    return add_terms


def launched(model, poses, ranges, monkeypatch):
    """Return flags and arguments of the gradient's launch, by name."""
    backend = get_backend("numpy")
    compiled, seen = backend.compile, []

    def compile_and_note(kernel, flags):
        launch = compiled(kernel, flags)

        def note(size, *values):
            if kernel == "field_gradient":
                copies = [value.copy() if isinstance(value, np.ndarray) else value for value in values]
                names = (argument.name for argument in KERNELS[kernel].with_flags(flags).arguments)
                seen.append((flags, SimpleNamespace(**dict(zip(names, copies, strict=True)))))
            launch(size, *values)

        return note

    monkeypatch.setattr(backend, "compile", compile_and_note)
    model.gradient(poses, ranges)
    monkeypatch.undo()
    (one,) = seen
    return one


@pytest.mark.parametrize("kind", KINDS)
def test_warps_tape_gives_the_gradient_of_the_kernel(kind, needs, monkeypatch):
    device = needs("warp:cpu")
    import warp as wp

    rng = np.random.default_rng(3)
    grid = gs.OccupancyGrid(100 * (rng.random((60, 80)) < 0.02), resolution=0.1, origin=(-40.0, 7.0, YAW))
    xy = grid.cell_centers(rng.integers(20, 40, 12), rng.integers(20, 60, 12)) + rng.uniform(-0.05, 0.05, (12, 2))
    poses, ranges = np.column_stack([xy, rng.uniform(-3, 3, 12)]), rng.uniform(0.5, 4.0, 40)
    parameters = gs.LikelihoodFieldParameters(interpolation="bilinear", **KINDS[kind])

    def model(backend):
        return gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=backend, precision="float64")

    flags, given = launched(model("numpy"), poses, ranges, monkeypatch)

    kernel, frame = tape_kernel(wp, flags), warp_module("prelude").Window()
    for name, value in given.window._asdict().items():
        setattr(frame, name, value)
    change = wp.zeros(len(poses), dtype=wp.vec3d, device="cpu", requires_grad=True)
    log_p = wp.zeros(len(poses), dtype=wp.float64, device="cpu", requires_grad=True)
    vectors = {"pose_cell": (wp.vec2i, 2), "pose": (wp.vec4d, 4), "point": (wp.vec2d, 2)}
    numbers = warp_module("prelude").precision(flags).FieldTerms
    terms = wp.array(ptr=given.terms.ctypes.data, dtype=numbers, shape=(1,), device="cpu")
    arrays = {"table": wp.array(given.table, dtype=wp.float64, device="cpu"), "terms": terms}
    for name, (dtype, length) in vectors.items():
        rows = getattr(given, name).reshape(-1, length)
        arrays[name] = wp.array(rows, dtype=dtype, device="cpu")
    mount = wp.vec2d(given.mount_x, given.mount_y)
    with wp.Tape() as tape:
        taken = [arrays[name] for name in ("table", "pose_cell", "pose", "point", "terms")]
        inputs = [change, *taken, log_p, frame, given.guard, mount, given.resolution]
        wp.launch(kernel, (len(poses), given.readings), inputs=inputs, device="cpu")
    tape.backward(grads={log_p: wp.ones_like(log_p)})
    expected, gradient, _ = model(device).gradient(poses, ranges)
    np.testing.assert_allclose(log_p.numpy() + given.score.constant_term, expected, rtol=1e-12)
    # The tape's changes are in the grid's frame.
    c, s = np.cos(YAW), np.sin(YAW)
    found = change.grad.numpy() @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(found, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())
    assert (np.abs(gradient).max(axis=1) > 0).all()
