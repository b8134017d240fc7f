"""Compare two trees (checkouts): is the new one slower, and does it compute the same bits?

    python bench/compare_trees.py speed --old ../before                # against this checkout, in turns
    python bench/compare_trees.py bits --old ../before --backend opencl --rays 200000 --models 3000
    python bench/compare_trees.py record --output old.json             # for trees of two machines, or in parts:
    python bench/compare_trees.py compare old.json new.json            # each record is made with PYTHONPATH=TREE

``speed`` is bench/trees/speed.py, the others are bench/trees/bits.py; each has its own ``--help``. Trees run in
processes of their own, through the public interface alone.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

USAGE = "usage: compare_trees.py {speed,bits,record,compare} ..."


def main() -> int:
    """Run a subcommand; each imports only the modules that it needs."""
    if len(sys.argv) > 1 and sys.argv[1] == "speed":
        from trees import speed

        return speed.main(sys.argv[2:])
    if len(sys.argv) > 1 and sys.argv[1] in ("bits", "record", "compare"):
        from trees import bits

        return bits.main(sys.argv[1:])
    asked = "-h" in sys.argv[1:2] or "--help" in sys.argv[1:2]
    print(f"{__doc__}\n{USAGE}" if asked else USAGE, file=sys.stdout if asked else sys.stderr)
    return 0 if asked else 2


if __name__ == "__main__":
    sys.exit(main())
