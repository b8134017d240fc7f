"""Run a gymnasium vector environment: robots with a lidar in many rooms, among obstacles that move.

    pip install "gpusense[gym]"
    python examples/many_worlds/navigation.py --rooms 256 --steps 100

Each room has one robot that must reach a goal, and discs that wander and bounce off the walls. An action is the forward
speed and the turn rate, both in [-1, 1]. An observation has the ranges of the lidar as parts of its longest range, then
the distance to the goal and the cosine and sine of its bearing. Rays, collisions and new rooms are computed on the
device in one call for all rooms. Rooms in which an episode ends get new walls at the same step. Actions are an array of
any library with DLPack, and ``wrap=torch.from_dlpack`` gives results as PyTorch's arrays.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

import gpusense as gs

SIDE, RESOLUTION, RADIUS, STEP = 96, 0.1, 0.2, 0.1
EXTENT = SIDE * RESOLUTION


class Navigation(gymnasium.vector.VectorEnv):
    """Drive one robot in each room among moving obstacles."""

    metadata: ClassVar = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}

    def __init__(
        self, rooms: int = 64, beams: int = 60, obstacles: int = 6, longest: int = 200, backend: str = "auto",
        wrap: Callable[[np.ndarray], Any] = np.asarray,
    ):  # fmt: skip
        self.wrap = wrap
        self.num_envs, self.beams, self.obstacles, self.longest = rooms, beams, obstacles, longest
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (beams + 3,), np.float32)
        self.action_space = batch_space(self.single_action_space, rooms)
        self.observation_space = batch_space(self.single_observation_space, rooms)
        self.bearings, self.range_max = np.linspace(-np.pi, np.pi, beams, endpoint=False), 6.0
        self.random, self.index = np.random.default_rng(0), np.arange(rooms)
        self.worlds = gs.Worlds(self.new_cells(rooms), RESOLUTION, backend=backend)
        self.caster = gs.RayCaster(self.worlds, self.range_max, backend=backend)
        self.poses, self.goals = np.zeros((rooms, 3)), np.zeros((rooms, 2))
        self.discs, self.velocity = np.zeros((rooms, obstacles, 3)), np.zeros((rooms, obstacles, 2))
        self.age = np.zeros(rooms, int)

    def new_cells(self, count: int) -> np.ndarray:
        """Return rooms with a wall around them and blocks in them; the middle stays free."""
        cells = np.zeros((count, SIDE, SIDE), np.int8)
        cells[:, [0, -1]] = cells[:, :, [0, -1]] = 100
        corner = self.random.integers(8, SIDE - 20, (count, 4, 2))
        for room, row, col in np.column_stack([np.arange(count).repeat(4), corner.reshape(-1, 2)]):
            cells[room, row : row + 10, col : col + 10] = 100
        middle = slice(SIDE // 2 - 8, SIDE // 2 + 8)
        cells[:, middle, middle] = 0
        return cells

    def begin(self, rooms: np.ndarray) -> None:
        """Begin an episode in some rooms."""
        count = len(rooms)
        self.poses[rooms] = (EXTENT / 2, EXTENT / 2, 0.0)
        self.poses[rooms, 2] = self.random.uniform(-np.pi, np.pi, count)
        angle, away = self.random.uniform(-np.pi, np.pi, count), self.random.uniform(2.5, 4.0, count)
        self.goals[rooms] = EXTENT / 2 + away[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        self.discs[rooms, :, :2] = self.random.uniform(1, EXTENT - 1, (count, self.obstacles, 2))
        self.discs[rooms, :, 2] = 0.25
        self.velocity[rooms] = self.random.normal(0, 0.5, (count, self.obstacles, 2))
        self.age[rooms] = 0

    def observe(self) -> np.ndarray:
        """Return the observations of all robots."""
        ranges = self.caster.cast(self.poses, self.bearings, world=self.index) / self.range_max
        ahead = self.goals - self.poses[:, :2]
        bearing = np.arctan2(ahead[:, 1], ahead[:, 0]) - self.poses[:, 2]
        goal = np.column_stack([np.hypot(*ahead.T), np.cos(bearing), np.sin(bearing)])
        return np.concatenate([ranges, goal], axis=1, dtype=np.float32, casting="same_kind")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Begin an episode in every room."""
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.worlds.replace(self.index, self.new_cells(self.num_envs))
        self.begin(self.index)
        self.worlds.shapes = gs.Shapes(discs=self.discs)
        return self.wrap(self.observe()), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict]:
        """Move robots and obstacles; begin anew where an episode ends."""
        given = np.from_dlpack(actions) if hasattr(actions, "__dlpack__") else np.asarray(actions)
        speed, turn = np.clip(given.astype(float), -1, 1).T
        before = np.hypot(*(self.goals - self.poses[:, :2]).T)
        self.poses[:, 2] += STEP * 2.0 * turn
        self.poses[:, :2] += (
            STEP * speed[:, None] * np.column_stack([np.cos(self.poses[:, 2]), np.sin(self.poses[:, 2])])
        )
        self.discs[..., :2] += STEP * self.velocity
        outside = (self.discs[..., :2] < 0.5) | (self.discs[..., :2] > EXTENT - 0.5)
        self.velocity[outside] *= -1
        self.worlds.shapes = gs.Shapes(discs=self.discs)
        self.age += 1
        left = np.hypot(*(self.goals - self.poses[:, :2]).T)
        crashed = self.worlds.collides(self.poses, RADIUS, world=self.index)
        arrived, late = left < 0.4, self.age >= self.longest
        reward = (before - left) + 10.0 * arrived - 10.0 * crashed
        over = np.flatnonzero(arrived | crashed | late)
        information: dict[str, Any] = {}
        if len(over):
            information["final_obs"] = self.wrap(self.observe())
            self.worlds.replace(over, self.new_cells(len(over)))
            self.begin(over)
            self.worlds.shapes = gs.Shapes(discs=self.discs)
        terminated = arrived | crashed
        results = self.observe(), reward.astype(np.float32), terminated, late & ~terminated
        return (*map(self.wrap, results), information)


def main() -> None:
    """Drive all robots towards their goals, and print the rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--rooms", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100)
    arguments = parser.parse_args()
    env = Navigation(arguments.rooms, backend=arguments.backend)
    observation, _ = env.reset(seed=0)
    ends, begin = 0, time.perf_counter()
    for _ in range(arguments.steps):
        heading = np.arctan2(observation[:, -1], observation[:, -2])
        nearest = observation[:, env.beams // 2 - 4 : env.beams // 2 + 5].min(axis=1)
        action = np.column_stack([np.where(nearest > 0.12, np.cos(heading), 0.0), heading + (nearest < 0.12)])
        observation, _, terminated, truncated, _ = env.step(action)
        ends += np.count_nonzero(terminated | truncated)
    seconds = time.perf_counter() - begin
    rate = arguments.steps * arguments.rooms / seconds
    print(f"{arguments.rooms} rooms on {env.worlds.device.selection}: {rate:.0f} steps a second, {ends} episodes ended")


if __name__ == "__main__":
    main()
