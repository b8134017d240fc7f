"""Cluster features that have a position: nearby features of one kind, direction and size form one landmark."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.features.feature_map import FeatureMap
from gpusense.features.result import KIND_TYPE, Features, Floats

# Features form one landmark if they are within this many deviations plus this distance [m], and differ at most by this
# direction [rad] and these sizes [m or rad].
_DEVIATIONS, _FLOOR, _TURN = 4.0, 0.03, 0.4
_SIZES = {"corner": 0.5, "door": 0.4, "pole": 0.1, "reflector": 0.1}

# Kinds without a direction.
ROUND = ("pole", "reflector")


@dataclass
class InWorld:
    """Features of one kind in the world."""

    scan: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    size: np.ndarray


def in_world(features: Features, poses: Floats, spread: Floats) -> InWorld:
    """Return features in the world; covariances include the errors of poses."""
    at = poses[features.scan]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    turn = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    off = (turn @ features.pose[:, :2, None])[..., 0]
    covariance = turn @ features.covariance[:, :2, :2] @ turn.transpose(0, 2, 1)
    across = np.stack([-off[:, 1], off[:, 0]], axis=1) * spread[1]
    covariance = covariance + np.eye(2) * spread[0] ** 2 + across[:, :, None] * across[:, None, :]
    pose = np.column_stack([at[:, :2] + off, at[:, 2] + features.pose[:, 2]])
    return InWorld(features.scan, pose, covariance, features.size)


def clustered(features: Features, poses: Floats, spread: Floats, kind: str, least: int) -> FeatureMap:
    """Return the landmarks of features of one kind."""
    world = in_world(features, poses, spread)
    clusters = _Clusters(kind)
    order = np.argsort(np.einsum("fii->f", world.covariance) if len(world.scan) else np.zeros(0), kind="stable")
    for i in order.tolist():
        clusters.add(world, i)
    label = np.array([clusters.nearest(world, i) for i in range(len(world.scan))], np.int64)
    return _fused(world, label, kind, least)


class _Clusters:
    """Growing landmarks, the most certain features first."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._information = np.zeros((0, 2, 2))
        self._sum = np.zeros((0, 2))
        self._pose = np.zeros((0, 3))
        self._covariance = np.zeros((0, 2, 2))
        self._size = np.zeros(0)

    def nearest(self, world: InWorld, i: int) -> int:
        """Return the nearest landmark that a feature may belong to, or -1."""
        off = self._pose[:, :2] - world.pose[i, :2]
        near = np.flatnonzero(np.abs(off).max(axis=1, initial=0) < 2.0)
        if not len(near):
            return -1
        both = self._covariance[near] + world.covariance[i] + np.eye(2) * _FLOOR**2
        distance = np.einsum("mi,mij,mj->m", off[near], np.linalg.inv(both), off[near])
        fits = np.abs(self._size[near] - world.size[i]) < _SIZES[self._kind]
        if self._kind not in ROUND:
            period = math.pi if self._kind == "door" else 2 * math.pi
            turn = np.mod(self._pose[near, 2] - world.pose[i, 2] + period / 2, period) - period / 2
            fits &= np.abs(turn) < _TURN
        distance = np.where(fits, distance, np.inf)
        best = int(distance.argmin())
        return int(near[best]) if distance[best] < _DEVIATIONS**2 else -1

    def add(self, world: InWorld, i: int) -> None:
        """Add a feature to the nearest landmark, or begin one."""
        j = self.nearest(world, i)
        information = np.linalg.inv(world.covariance[i])
        if j < 0:
            self._information = np.concatenate([self._information, information[None]])
            self._sum = np.concatenate([self._sum, (information @ world.pose[i, :2])[None]])
            self._pose = np.concatenate([self._pose, world.pose[i][None]])
            self._covariance = np.concatenate([self._covariance, world.covariance[i][None]])
            self._size = np.append(self._size, world.size[i])
            return
        self._information[j] += information
        self._sum[j] += information @ world.pose[i, :2]
        self._covariance[j] = np.linalg.inv(self._information[j])
        self._pose[j, :2] = self._covariance[j] @ self._sum[j]


def _fused(world: InWorld, label: np.ndarray, kind: str, least: int) -> FeatureMap:
    """Return each landmark as the weighted mean of its features."""
    poses, covariances, sizes, counts = [], [], [], []
    for j in range(int(label.max(initial=-1)) + 1):
        rows = np.flatnonzero(label == j)
        if len(np.unique(world.scan[rows])) < least:
            continue
        information = np.linalg.inv(world.covariance[rows])
        covariance = np.linalg.inv(information.sum(axis=0))
        xy = covariance @ np.einsum("fij,fj->i", information, world.pose[rows, :2])
        off = world.pose[rows, :2] - xy
        scatter = np.einsum("fi,fij,fj->", off, information, off) / max(2 * len(rows) - 2, 1)
        factor = 2 if kind == "door" else 1
        theta = np.angle(np.exp(1j * factor * world.pose[rows, 2]).sum()) / factor if kind not in ROUND else 0.0
        poses.append([*xy, theta])
        covariances.append(covariance * max(scatter, 1.0))
        sizes.append(np.median(world.size[rows]))
        counts.append(len(rows))
    return FeatureMap(
        np.full(len(counts), kind, KIND_TYPE), np.array(poses).reshape(-1, 3), np.array(covariances).reshape(-1, 2, 2),
        np.array(sizes, float), np.array(counts, np.int64),
    )  # fmt: skip
