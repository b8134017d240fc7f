"""Run a gymnasium vector environment on a device: robots with a lidar in many rooms, among obstacles that move.

    pip install "gpusense[gym]"
    python examples/many_worlds/navigation.py --backend warp:cuda:0 --rooms 4096 --steps 200

Each room has one robot that must reach a goal, and discs that wander and bounce off the walls. An action is the forward
speed and the turn rate, both in [-1, 1]. An observation has the ranges of the lidar as parts of its longest range, then
the distance to the goal and the cosine and sine of its bearing. All state stays on the device: two kernels of Warp move
and judge, and begin an episode at the step after the last one's end; a bound call casts all rays. Actions are an array
of any library with DLPack. ``wrap=torch.from_dlpack`` gives results as PyTorch's arrays, without a copy; the next step
overwrites them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
import warp as wp
from gymnasium.vector.utils import batch_space

import gpusense as gs

SIDE, RESOLUTION, RADIUS, STEP, RANGE = 96, 0.1, 0.2, 0.1, 6.0
EXTENT = wp.constant(SIDE * RESOLUTION)


@wp.func
def distance(poses: wp.array2d(dtype=float), goals: wp.array2d(dtype=float), room: int):
    """Return the distance of a robot from its goal [m]."""
    return wp.length(wp.vec2(goals[room, 0] - poses[room, 0], goals[room, 1] - poses[room, 1]))


@wp.kernel
def advance(
    seed: int, actions: wp.array2d(dtype=float), over: wp.array(dtype=wp.uint8), poses: wp.array2d(dtype=float),
    goals: wp.array2d(dtype=float), discs: wp.array3d(dtype=float), velocity: wp.array3d(dtype=float),
    age: wp.array(dtype=int), before: wp.array(dtype=float),
):  # fmt: skip
    """Move the robot and the discs of a room, or begin an episode."""
    room = wp.tid()
    if over[room] != wp.uint8(0):
        draw = wp.rand_init(seed, room)
        poses[room, 0] = EXTENT / 2.0
        poses[room, 1] = EXTENT / 2.0
        poses[room, 2] = wp.randf(draw, -wp.pi, wp.pi)
        angle, away = wp.randf(draw, -wp.pi, wp.pi), wp.randf(draw, 2.5, 4.0)
        goals[room, 0] = EXTENT / 2.0 + away * wp.cos(angle)
        goals[room, 1] = EXTENT / 2.0 + away * wp.sin(angle)
        for disc in range(discs.shape[1]):
            for axis in range(2):
                discs[room, disc, axis] = wp.randf(draw, 1.0, EXTENT - 1.0)
                velocity[room, disc, axis] = 0.5 * wp.randn(draw)
            discs[room, disc, 2] = 0.25
        age[room] = 0
        before[room] = distance(poses, goals, room)
        return
    before[room] = distance(poses, goals, room)
    ahead = STEP * wp.clamp(actions[room, 0], -1.0, 1.0)
    heading = poses[room, 2] + STEP * 2.0 * wp.clamp(actions[room, 1], -1.0, 1.0)
    poses[room, 0] = poses[room, 0] + ahead * wp.cos(heading)
    poses[room, 1] = poses[room, 1] + ahead * wp.sin(heading)
    poses[room, 2] = heading
    for disc in range(discs.shape[1]):
        for axis in range(2):
            at = discs[room, disc, axis] + STEP * velocity[room, disc, axis]
            discs[room, disc, axis] = at
            if at < 0.5 or at > EXTENT - 0.5:
                velocity[room, disc, axis] = -velocity[room, disc, axis]
    age[room] = age[room] + 1


@wp.kernel
def judge(
    longest: int, ranges: wp.array2d(dtype=float), hit: wp.array(dtype=wp.uint8), poses: wp.array2d(dtype=float),
    goals: wp.array2d(dtype=float), age: wp.array(dtype=int), before: wp.array(dtype=float),
    observation: wp.array2d(dtype=float), reward: wp.array(dtype=float), terminated: wp.array(dtype=wp.uint8),
    truncated: wp.array(dtype=wp.uint8), over: wp.array(dtype=wp.uint8),
):  # fmt: skip
    """Observe a room, reward its robot, and find whether the episode ends."""
    room = wp.tid()
    beams = ranges.shape[1]
    for k in range(beams):
        observation[room, k] = ranges[room, k] / RANGE
    left = distance(poses, goals, room)
    bearing = wp.atan2(goals[room, 1] - poses[room, 1], goals[room, 0] - poses[room, 0]) - poses[room, 2]
    observation[room, beams] = left
    observation[room, beams + 1] = wp.cos(bearing)
    observation[room, beams + 2] = wp.sin(bearing)
    crashed = age[room] > 0 and hit[room] != wp.uint8(0)
    arrived = age[room] > 0 and left < 0.4
    reward[room] = before[room] - left + wp.where(arrived, 10.0, 0.0) - wp.where(crashed, 10.0, 0.0)
    terminated[room] = wp.uint8(wp.where(arrived or crashed, 1, 0))
    truncated[room] = wp.uint8(wp.where(age[room] >= longest and not (arrived or crashed), 1, 0))
    over[room] = terminated[room] | truncated[room]


@wp.kernel
def steer(observation: wp.array2d(dtype=float), actions: wp.array2d(dtype=float)):
    """Head for the goal, and turn away from what is near ahead."""
    room = wp.tid()
    beams = observation.shape[1] - 3
    nearest = observation[room, beams // 2]
    for k in range(beams // 2 - 4, beams // 2 + 5):
        nearest = wp.min(nearest, observation[room, k])
    heading = wp.atan2(observation[room, beams + 2], observation[room, beams + 1])
    actions[room, 0] = wp.where(nearest > 0.12, wp.cos(heading), 0.0)
    actions[room, 1] = heading + wp.where(nearest < 0.12, 1.0, 0.0)


class Navigation(gymnasium.vector.VectorEnv):
    """Drive one robot in each room among moving obstacles."""

    metadata: ClassVar = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}

    def __init__(
        self, rooms: int = 64, beams: int = 64, obstacles: int = 6, longest: int = 200, backend: str = "auto",
        wrap: Callable[[Any], Any] = wp.array.numpy,
    ):  # fmt: skip
        self.wrap, self.num_envs, self.longest, self.random = wrap, rooms, longest, np.random.default_rng(0)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (beams + 3,), np.float32)
        self.action_space = batch_space(self.single_action_space, rooms)
        self.observation_space = batch_space(self.single_observation_space, rooms)
        self.worlds = gs.Worlds(self.new_cells(), RESOLUTION, backend=backend)
        selection = self.worlds.device.selection
        self.device = selection.removeprefix("warp:") if selection.startswith("warp:cuda") else "cpu"
        shapes = {"poses": (rooms, 3), "goals": (rooms, 2), "discs": (rooms, obstacles, 3),
                  "velocity": (rooms, obstacles, 2), "ranges": (rooms, beams), "before": rooms, "reward": rooms,
                  "observation": (rooms, beams + 3), "actions": (rooms, 2)}  # fmt: skip
        self.state = {name: wp.zeros(shape, dtype=float, device=self.device) for name, shape in shapes.items()}
        self.state["age"] = wp.zeros(rooms, dtype=int, device=self.device)
        for name in ("terminated", "truncated", "over"):
            self.state[name] = wp.zeros(rooms, dtype=wp.uint8, device=self.device)
        self.index = wp.array(np.arange(rooms, dtype=np.int32), device=self.device)
        bearings = np.linspace(-np.pi, np.pi, beams, endpoint=False)
        self.cast = gs.RayCaster(self.worlds, RANGE, backend=backend).bind(
            self.state["poses"], bearings, world=self.index, out=self.state["ranges"]
        )

    def new_cells(self) -> np.ndarray:
        """Return rooms with a wall around them and blocks in them; the middle stays free."""
        cells = np.zeros((self.num_envs, SIDE, SIDE), np.int8)
        cells[:, [0, -1]] = cells[:, :, [0, -1]] = 100
        corner = self.random.integers(8, SIDE - 20, (self.num_envs, 4, 2))
        for room, row, col in np.column_stack([np.arange(self.num_envs).repeat(4), corner.reshape(-1, 2)]):
            cells[room, row : row + 10, col : col + 10] = 100
        middle = slice(SIDE // 2 - 8, SIDE // 2 + 8)
        cells[:, middle, middle] = 0
        return cells

    def launch(self, kernel: Any, *numbers: int) -> None:
        """Launch a kernel for all rooms; its arrays are the state."""
        arrays = [self.state[argument.label] for argument in kernel.adj.args[len(numbers) :]]
        wp.launch(kernel, self.num_envs, [*numbers, *arrays], device=self.device)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Build new walls, and begin an episode in every room."""
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.worlds.replace(np.arange(self.num_envs), self.new_cells())
        self.state["over"].fill_(1)
        return self.step(self.state["actions"])[0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict]:
        """Move robots and obstacles; begin an episode where the last step ended one."""
        given = wp.from_dlpack(actions) if hasattr(actions, "__dlpack__") else wp.array(actions, dtype=float)
        self.state["actions"] = given.to(self.device)
        self.launch(advance, int(self.random.integers(2**31)))
        self.worlds.shapes = gs.Shapes(discs=self.state["discs"])
        self.cast()
        hit = self.worlds.collides(self.state["poses"], RADIUS, world=self.index)
        self.state["hit"] = hit.view(wp.uint8)
        self.launch(judge, self.longest)
        results = [self.state[name] for name in ("observation", "reward", "terminated", "truncated")]
        return *map(self.wrap, results), {}


def main() -> None:
    """Drive all robots towards their goals, and print the rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--rooms", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100)
    arguments = parser.parse_args()
    env = Navigation(arguments.rooms, backend=arguments.backend, wrap=lambda array: array)
    env.reset(seed=0)
    ends = 0
    for step in range(-10, arguments.steps):
        if step == 0:
            wp.synchronize()
            begin = time.perf_counter()
        env.launch(steer)
        _, _, terminated, truncated, _ = env.step(env.state["actions"])
    wp.synchronize()
    rate = arguments.steps * arguments.rooms / (time.perf_counter() - begin)
    ends = np.count_nonzero(terminated.numpy() | truncated.numpy())
    print(
        f"{arguments.rooms} rooms on {env.worlds.device.selection}: {rate:.0f} steps a second, {ends} ended at the last"
    )


if __name__ == "__main__":
    main()
