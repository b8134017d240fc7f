"""Cast the lidars of ir-sim's robots with gpusense, and compare with ir-sim's ranges.

    pip install ir-sim
    python examples/many_worlds/ir_sim.py [--robots 20] [--obstacles 30]

``shapes_of`` turns the objects of a scene into moving shapes: the outlines of all objects become segments, as ir-sim
itself sees them. A robot does not see itself, so each robot has a separate world without its outline.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs


def shapes_of(env: Any) -> gs.Shapes:
    """Return the outlines of all objects other than the robot itself, for each robot."""
    outlines = []
    for thing in env.objects:
        outline = np.array(getattr(thing.geometry, "exterior", thing.geometry).coords)
        outlines.append((thing, np.column_stack([outline[:-1], outline[1:]])))
    seen = [np.concatenate([lines for thing, lines in outlines if thing is not robot]) for robot in env.robot_list]
    segments = np.full((len(seen), max(map(len, seen)), 4), np.nan)
    for world, lines in enumerate(seen):
        segments[world, : len(lines)] = lines
    return gs.Shapes(segments=segments)


def scene(robots: int, obstacles: int) -> str:
    """Return a scene of ir-sim as YAML."""
    lidar = "{name: lidar2d, range_min: 0, range_max: 10, angle_range: 6.28, number: 360}"
    return f"""
world: {{height: 30, width: 30, step_time: 0.1, control_mode: auto, collision_mode: unobstructed}}
robot:
  - {{number: {robots}, kinematics: {{name: diff}}, shape: {{name: circle, radius: 0.2}}, behavior: {{name: dash}},
     distribution: {{name: random, range_low: [2, 2, -3], range_high: [28, 28, 3]}}, sensors: [{lidar}]}}
obstacle:
  - {{number: {obstacles}, shape: {{name: rectangle, length: 1.2, width: 0.6}},
     distribution: {{name: random, range_low: [2, 2, -3], range_high: [28, 28, 3]}}}}
"""


def main() -> None:
    """Compare ranges and times in one scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--obstacles", type=int, default=30)
    arguments = parser.parse_args()
    import irsim

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.yaml")
        path.write_text(scene(arguments.robots, arguments.obstacles))
        env = irsim.make(str(path), display=False, save_ani=False)
    robots = env.robot_list
    begin = time.perf_counter()
    for robot in robots:
        robot.lidar.step(robot.state)
    theirs = time.perf_counter() - begin
    worlds = gs.Worlds(np.zeros((len(robots), 8, 8), np.int8), 5.0, (-5.0, -5.0, 0.0), backend=arguments.backend)
    caster = gs.RayCaster(worlds, 10.0, backend=arguments.backend)
    poses, index = np.array([robot.state[:3, 0] for robot in robots]), np.arange(len(robots))
    for _ in range(2):  # the first call compiles
        begin = time.perf_counter()
        worlds.shapes = shapes_of(env)
        ranges = caster.cast(poses, robots[0].lidar.angle_list, world=index)
        ours = time.perf_counter() - begin
    away = np.abs(ranges - np.array([robot.lidar.range_data for robot in robots]))
    print(f"{ranges.size} rays: largest difference {away.max():.2g} m, median {np.median(away):.1g} m")
    print(f"ir-sim {1e3 * theirs:.1f} ms, gpusense on {worlds.device.selection} {1e3 * ours:.1f} ms")


if __name__ == "__main__":
    main()
