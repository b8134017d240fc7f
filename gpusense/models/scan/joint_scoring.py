"""Several models of one device in one call, with a single wait: models of different maps, sensors or kinds."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

from gpusense._util import checks
from gpusense.models.chunking import finish_all
from gpusense.models.poses import Poses
from gpusense.models.scan.model import ScanModel
from gpusense.models.scan.pipeline import make_request


def log_likelihoods(models: Sequence[ScanModel], poses: Any, ranges: Any, *, out: Any = None) -> list[Any]:
    """Return log p(z | x, m) of several beam models and likelihood fields in one call.

    All models enqueue their launches, and the call waits for the device once. Models may differ in everything but the
    device: maps (of floors or robots), scanners, parameters, precision. A model may occur several times.

    Args:
        models: :class:`BeamModel` and :class:`LikelihoodFieldModel` objects of one device.
        poses: As for ``log_likelihood``, (N, 3) or (S, N, 3): one array for all models, or a list or tuple with an
            array per model.
        ranges: (K,) or (S, K) readings: one array for all models, or a list or tuple with an array per model.
        out: None, or a list or tuple with an array or None for each model's result, as in ``log_likelihood``.

    Returns:
        A list of the results of ``log_likelihood`` of each model, with the same bits: (N,) or (S, N).

    Raises:
        TypeError: Models of another type, or an argument of one of them that breaks its rule.
        ValueError: Models of several devices, a list of another length, or an argument that breaks its rule.
        MemoryError: The device cannot hold a map's table, or even a few particles.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid, scanner = gs.OccupancyGrid([[0] * 20 + [100]]), gs.Scanner([0.0], range_max=4.0)
        >>> models = [kind(grid, scanner, backend="numpy") for kind in (gs.BeamModel, gs.LikelihoodFieldModel)]
        >>> poses, ranges = np.array([(0.5, 0.05, 0.0), (0.4, 0.05, 0.0)]), np.array([0.5])
        >>> [log_p.shape for log_p in gs.log_likelihoods(models, poses, ranges)]
        [(2,), (2,)]
    """
    chosen = _checked(models)
    if not chosen:
        return []
    each_poses, each_ranges = _one_each("poses", poses, len(chosen)), _one_each("ranges", ranges, len(chosen))
    if out is not None and not isinstance(out, (list, tuple)):
        raise TypeError(f"out: must be a list or tuple of one array for each model, got {checks.show(out)}")
    each_out = _one_each("out", out, len(chosen))
    known: dict[int, dict[int | None, Poses]] = {}
    requests = []
    for model, model_poses, model_ranges, model_out in zip(chosen, each_poses, each_ranges, each_out, strict=True):
        # Poses that several models share are checked once.
        shared = known.setdefault(id(model_poses), {})
        requests.append(make_request(model._context, model_poses, model_ranges, model_out, known=shared))
    # A fixed order of locks, so that two such calls cannot deadlock.
    different = sorted({id(model): model for model in chosen}.items())
    with contextlib.ExitStack() as stack:
        for _, model in different:
            stack.enter_context(model._lock)
        for _, model in different:
            stack.push(lambda kind, *error, space=model._workspace: space.abandon() if kind else None)
        # Left first, so that the batch is started before an error abandons its memory.
        stack.enter_context(chosen[0]._workspace)
        for model, request in zip(chosen, requests, strict=True):
            model._run(request)
            model._workspace.submit()
        on_device = {id(model) for model, request in zip(chosen, requests, strict=True) if request.poses.on_device}
        finish_all([(model._workspace, key in on_device) for key, model in different])
    return [request.result.user_array() for request in requests]


def _checked(models: object) -> list[ScanModel]:
    """Return models of one device as a list."""
    if not isinstance(models, (list, tuple)):
        raise TypeError(f"models: must be a list or tuple of models, got {checks.show(models)}")
    for i, model in enumerate(models):
        if not isinstance(model, ScanModel):
            rule = "must be BeamModel or LikelihoodFieldModel objects"
            raise TypeError(f"models: {rule}, got {checks.show(model)} at index {i}")
        if model._context.backend is not models[0]._context.backend:
            selections = f"{models[0].device.selection} and, at index {i}, {model.device.selection}"
            raise ValueError(f"models: must be of one device, got {selections}")
    return list(models)


def _one_each(name: str, value: Any, count: int) -> list[Any]:
    """Return an argument of each model: an entry of a list or tuple, or the same value for all."""
    if not isinstance(value, (list, tuple)):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name}: a list must have one entry for each of {count} models, got {len(value)}")
    return list(value)
