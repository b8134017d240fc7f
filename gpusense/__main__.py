"""``python -m gpusense`` is the command ``gpusense``."""

from __future__ import annotations

import sys

from gpusense.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
