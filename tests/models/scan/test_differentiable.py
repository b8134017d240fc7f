"""Log-likelihoods for PyTorch and JAX to differentiate; the rule is tested without these libraries."""

from __future__ import annotations

import math
import sys
import types

import numpy as np
import pytest
from support.array_libraries import Recorded

import gpusense as gs
from gpusense.models.scan import field_gradient

SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.2, count=20, range_max=6.0, mount=(0.3, -0.1, 0.4))
RNG = np.random.default_rng(5)
GRID = gs.OccupancyGrid(100 * (RNG.random((60, 80)) < 0.02), resolution=0.1, origin=(2.0, 1.0, 0.6))
POSES = np.column_stack([GRID.cell_centers(RNG.integers(20, 40, 4), RNG.integers(20, 60, 4)), RNG.uniform(-3, 3, 4)])
RANGES = RNG.uniform(0.5, 4.0, 20)


def field(interpolation="bilinear", precision="float64", backend="numpy"):
    parameters = gs.LikelihoodFieldParameters(interpolation=interpolation)
    return gs.LikelihoodFieldModel(GRID, SCANNER, parameters, backend=backend, precision=precision)


class Tensor:
    """A tensor of a made-up PyTorch that records gradients."""

    __module__ = "torch"
    device, requires_grad = "cpu", True

    def __init__(self, values):
        self.values, self.dtype = values, values.dtype

    def detach(self):
        return self.values


def test_the_rule_multiplies_the_gradient_by_what_comes_from_above(monkeypatch):
    """A substitute for PyTorch calls ``forward`` and ``backward`` of operations."""
    made = []

    class Function:
        @classmethod
        def apply(cls, poses):
            context = types.SimpleNamespace(save_for_backward=lambda *saved: setattr(context, "saved_tensors", saved))
            result = cls.forward(context, poses)
            made.append(lambda pull: cls.backward(context, pull))
            return result

    class Numbers(np.ndarray):
        def to(self, where):
            return self if where == "cpu" else self.astype(where)

    function = types.SimpleNamespace(once_differentiable=lambda call: call)
    torch = types.SimpleNamespace(
        autograd=types.SimpleNamespace(Function=Function, function=function), is_grad_enabled=lambda: True,
        from_numpy=lambda array: array.view(Numbers),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "torch", torch)
    model = field()
    log_p, gradient, _ = model.gradient(POSES, RANGES)
    found = model.log_likelihood(Tensor(POSES.astype(np.float32).astype(float)), RANGES)
    np.testing.assert_allclose(found, log_p, atol=1e-3)
    found = model.log_likelihood(Tensor(POSES), RANGES)
    np.testing.assert_array_equal(found, log_p)
    pull = np.array([1.0, -2.0, 0.0, 0.5])
    np.testing.assert_array_equal(made[-1](pull), pull[:, None] * gradient)
    torch.is_grad_enabled = lambda: False
    np.testing.assert_array_equal(model.log_likelihood(Tensor(POSES), RANGES), log_p)


def test_models_without_a_gradient_refuse_recorded_poses():
    assert not field_gradient.is_recorded(POSES)
    for model in (field("nearest"), gs.BeamModel(GRID, SCANNER, backend="numpy")):
        with pytest.raises(TypeError, match=r"poses: must not require gradients"):
            model.log_likelihood(Recorded(POSES), RANGES)
        assert model._differentiable(RANGES) is None


@pytest.mark.parametrize("several", [False, True])
def test_pytorch_differentiates(several, backend):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    model = field(backend=backend)
    poses, ranges = (POSES.reshape(2, 2, 3), np.stack([RANGES, RANGES[::-1]])) if several else (POSES, RANGES)
    tensor = torch.tensor(poses, requires_grad=True)
    assert torch.autograd.gradcheck(lambda at: model.log_likelihood(at, ranges), tensor, eps=1e-7, rtol=1e-4, atol=1e-3)
    model.log_likelihood(tensor, torch.tensor(ranges)).sum().backward()
    np.testing.assert_allclose(tensor.grad.numpy(), model.gradient(poses, ranges)[1], rtol=1e-12)
    with torch.no_grad():
        assert not model.log_likelihood(tensor, ranges).requires_grad
    single = torch.tensor(poses.astype(np.float32), requires_grad=True)
    field(precision="float32", backend=backend).log_likelihood(single, ranges).sum().backward()
    assert single.grad.dtype == torch.float32
    with pytest.raises(TypeError, match="must not require gradients"):
        field("nearest").log_likelihood(tensor, ranges)


def test_jax_differentiates():
    jax = pytest.importorskip("jax", reason="JAX is not installed")
    model = field(precision="float32", backend="opencl")
    loss = jax.jit(lambda poses: 2 * model.log_likelihood(poses, RANGES).sum())
    value, gradient = jax.value_and_grad(loss)(POSES.astype(np.float32))
    log_p, expected, _ = model.gradient(POSES.astype(np.float32), RANGES)
    assert float(value) == pytest.approx(2 * log_p.sum(), rel=1e-6)
    np.testing.assert_allclose(np.asarray(gradient), 2 * expected, rtol=1e-6)
    # JAX may sum in another order.
    np.testing.assert_allclose(loss(POSES.astype(np.float32)), value, rtol=1e-6)


def test_jax_maps_over_batches_of_poses():
    jax = pytest.importorskip("jax", reason="JAX is not installed")
    model, poses = field(precision="float32", backend="opencl"), POSES.astype(np.float32)
    single = jax.vmap(jax.value_and_grad(lambda pose: model.log_likelihood(pose[None], RANGES)[0]))
    log_p, gradient, _ = model.gradient(poses, RANGES)
    for found, expected in zip(single(poses), (log_p, gradient), strict=True):
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(TypeError, match="ranges: must have values, got an array that JAX traces"):
        jax.vmap(model.log_likelihood)(np.stack([poses] * 2), np.stack([RANGES] * 2))
    with pytest.raises(TypeError, match="poses: must have values"):
        jax.vmap(lambda at: field("nearest").log_likelihood(at, RANGES))(np.stack([poses] * 2))


@pytest.mark.parametrize(("shape", "axes"), [((4, 3), 2), ((5, 4, 3), 2), ((5, 4, 3), 3), ((2, 5, 4, 3), 3)])
def test_batches_of_poses_are_joined_and_split(shape, axes):
    poses = np.arange(np.prod(shape), dtype=float).reshape(shape)
    joined, split = field_gradient._batches(poses, axes)
    # Poses of a scan stay with their scan.
    assert joined.shape == (*shape[-axes:-2], poses[..., 0].size // math.prod(shape[-axes:-2]), 3)
    if axes == 3:
        np.testing.assert_array_equal(joined[1][: shape[-2]], poses.reshape(-1, *shape[-3:])[0, 1])
    np.testing.assert_array_equal(split(joined[..., 0]), poses[..., 0])
    np.testing.assert_array_equal(split(joined), poses)
