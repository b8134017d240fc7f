"""The commands of ``gpusense``, a module each.

A command module has

- ``NAME: str``, what the user types;
- ``HELP: str``, one line that ``gpusense --help`` shows;
- ``add_arguments(parser) -> None``, which may also set ``parser.description`` and ``parser.epilog`` (shown as written);
- ``run(args) -> int``, the exit code.

Importing one is cheap: backends, drawing and rich are imported where they are used. What ``run`` raises as ValueError,
TypeError, OSError or MemoryError reaches the user as one line on standard error.
"""
