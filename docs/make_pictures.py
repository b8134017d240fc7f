"""Make the pictures of README.md and of the site's first page: python docs/make_pictures.py.

They are the animation of README's commands, and the picture of ``gpusense demo`` at half its size with a palette of 128
colours.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

WIDTH, COLOURS = 1100, 128
TARGET = Path(__file__).parent / "img" / "demo.png"
MOVIE = TARGET.with_name("run.gif")
COMMANDS = (
    "simulate --world office:1 --map-out map.yaml --log-out run.bag --scans 100",
    f"localize --map map.yaml --log run.bag --global --animate {MOVIE}",
)


def main() -> None:
    """Animate a run, and draw the demo, shrink its picture and write it."""
    with tempfile.TemporaryDirectory() as folder:
        for command in COMMANDS:
            subprocess.run([sys.executable, "-m", "gpusense", *command.split()], check=True, cwd=folder)
        drawn = Path(folder, "demo.png")
        subprocess.run([sys.executable, "-m", "gpusense", "demo", "--output", drawn], check=True)
        with Image.open(drawn) as picture:
            size = WIDTH, round(picture.height * WIDTH / picture.width)
            small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    small.quantize(COLOURS, dither=Image.Dither.NONE).save(TARGET, optimize=True)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
