"""Log-likelihoods as operations that PyTorch and JAX differentiate, by the model's own gradient.

A library is imported only after an array of it has been passed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks


class Differentiable(NamedTuple):
    """The calls of a model that an operation makes."""

    log_p: Callable[[Any], Any]  # log-likelihoods of poses
    # Log-likelihoods of poses, and their derivatives with respect to the poses; NumPy arrays.
    gradient: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    real: np.dtype  # precision of both


def is_recorded(poses: object) -> bool:
    """Return whether poses are a tensor of PyTorch whose gradients are recorded, or are being traced by JAX."""
    name = type(poses).__module__.partition(".")[0]
    if name == "torch":
        return getattr(poses, "requires_grad", False) is True
    return name == "jax" and isinstance(poses, sys.modules["jax"].core.Tracer)


def log_likelihood_of(poses: Any, ranges: object, calls: Differentiable) -> Any:
    """Return the log-likelihoods of recorded poses as an operation of their library."""
    checks.check_values("ranges", ranges)
    if type(poses).__module__.partition(".")[0] == "torch":
        return _torch_log_likelihood(sys.modules["torch"], poses, calls)
    return _jax_log_likelihood(sys.modules["jax"], poses, calls)


def _torch_log_likelihood(torch: Any, poses: Any, calls: Differentiable) -> Any:
    """Return log-likelihoods as an operation of ``torch.autograd``; its own derivatives are not recorded."""

    def forward(ctx: Any, at: Any) -> Any:
        log_p, gradient = calls.gradient(at.detach())
        ctx.save_for_backward(torch.from_numpy(gradient).to(at.device))
        return torch.from_numpy(log_p).to(at.device)

    def backward(ctx: Any, pull: Any) -> Any:
        (gradient,) = ctx.saved_tensors
        # PyTorch expects a gradient in the precision of its input.
        return (pull[..., None] * gradient).to(poses.dtype)

    if not torch.is_grad_enabled():
        return calls.log_p(poses.detach())
    methods = {
        "forward": staticmethod(forward),
        "backward": staticmethod(torch.autograd.function.once_differentiable(backward)),
    }
    operation: Any = type("LogLikelihood", (torch.autograd.Function,), methods)
    return operation.apply(poses)


def _jax_log_likelihood(jax: Any, poses: Any, calls: Differentiable) -> Any:
    """Return log-likelihoods with a rule for their derivatives; the model is called back from JAX's program."""
    if poses.ndim < 2 or poses.shape[-1] != 3:
        raise ValueError(f"poses: shape must be (N, 3) or (S, N, 3), got {checks.shape_text(poses.shape)}")
    real = jax.dtypes.canonicalize_dtype(calls.real)
    values = jax.ShapeDtypeStruct(poses.shape[:-1], real)
    slopes = jax.ShapeDtypeStruct(poses.shape, real)

    def plain(at: Any) -> np.ndarray:
        joined, split = _batches(np.asarray(at), poses.ndim)
        return split(np.asarray(calls.log_p(joined), real))

    def both(at: Any) -> tuple[np.ndarray, np.ndarray]:
        joined, split = _batches(np.asarray(at), poses.ndim)
        log_p, gradient = calls.gradient(joined)
        return split(log_p.astype(real)), split(gradient.astype(real))

    # vmap adds leading axes to the poses: one call scores all batches.
    def forward(at: Any) -> tuple[Any, Any]:
        return jax.pure_callback(both, (values, slopes), at, vmap_method="expand_dims")

    def backward(gradient: Any, pull: Any) -> tuple[Any]:
        return ((pull[..., None] * gradient).astype(poses.dtype),)

    operation = jax.custom_vjp(lambda at: jax.pure_callback(plain, values, at, vmap_method="expand_dims"))
    operation.defvjp(forward, backward)
    return operation(poses)


def _batches(poses: np.ndarray, axes: int) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Join batches of (N, 3) or (S, N, 3) poses to one of more poses.

    Returns:
        (M, 3) or (S, M, 3) poses, and a function that splits results of this leading shape into the batches.
    """
    outer, inner = poses.shape[: poses.ndim - axes], poses.shape[poses.ndim - axes :]
    # The scans come first, the batches of a scan after them.
    flat = np.moveaxis(poses.reshape(-1, *inner), 0, axes - 2)

    def split(results: np.ndarray) -> np.ndarray:
        rest = results.shape[axes - 1 :]
        return np.moveaxis(results.reshape(*flat.shape[:-1], *rest), axes - 2, 0).reshape(*outer, *inner[:-1], *rest)

    return flat.reshape(*inner[:-2], -1, 3), split
