"""Make the pictures of README.md and of the site's first page: python docs/make_pictures.py.

They are the animation of README's commands, the picture of ``gpusense demo`` at half its size with a palette of 256
colours, and the picture of ``docs/judge.md``: a trajectory that slides away for a third of a simulated run.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import gpusense as gs
from gpusense.plots.runs import judgement_figure

WIDTH, COLOURS = 1100, 256
TARGET = Path(__file__).parent / "img" / "demo.png"
MOVIE = TARGET.with_name("run.gif")
COMMANDS = (
    "simulate --world office:3 --map-out map.yaml --log-out run.bag --scans 100",
    f"localize --map map.yaml --log run.bag --global --animate {MOVIE}",
)


def draw_judgement() -> None:
    """Draw the judgement of a trajectory that slides away by up to 3 m, with the Stanford diagram."""
    grid = gs.worlds.building(seed=1)
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=20.0)
    run = gs.worlds.simulate_run(grid, scanner, scans=240, seed=1)
    scans = [
        gs.Scan(time, ranges, scanner, tuple(odometry), None)
        for time, ranges, odometry in zip(run.times.tolist(), run.scans, run.odometry, strict=True)
    ]
    slide = np.zeros((240, 3))
    slide[90:160, 1] = np.linspace(0, 3, 70)
    poses = gs.compose_poses(run.poses, np.random.default_rng(0).normal(0, (0.03, 0.03, 0.005), (240, 3)))
    poses = gs.compose_poses(poses, slide)
    spread = np.tile(np.diag([0.03, 0.03, 0.005]) ** 2, (240, 1, 1))
    model = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(sigma_hit=0.07))
    found = gs.judge_trajectory(model, scans, poses, covariances=spread)
    errors = np.hypot(*(found.poses - run.poses)[:, :2].T)
    rated = gs.integrity(errors, found.radii, alert_limit=0.5, times=found.times)
    target = TARGET.with_name("judge.png")
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder, "judge.png")
        gs.plots.save(judgement_figure(grid, found, rated, errors), drawn)
        _shrink(drawn, target)
    print(found, rated, f"{target}: {target.stat().st_size} bytes", sep="\n")


def _shrink(drawn: Path, target: Path) -> None:
    """Write a picture at a width and with a palette that suit a page."""
    with Image.open(drawn) as picture:
        size = WIDTH, round(picture.height * WIDTH / picture.width)
        small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    small.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)


def main() -> None:
    """Animate a run, draw the demo and a judgement, and shrink the pictures."""
    with tempfile.TemporaryDirectory() as folder:
        for command in COMMANDS:
            subprocess.run([sys.executable, "-m", "gpusense", *command.split()], check=True, cwd=folder)
        drawn = Path(folder, "demo.png")
        subprocess.run([sys.executable, "-m", "gpusense", "demo", "--output", drawn], check=True)
        _shrink(drawn, TARGET)
    draw_judgement()
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
