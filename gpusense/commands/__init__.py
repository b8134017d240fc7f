"""The commands of ``gpusense``, one module each.

A command module has

- ``NAME: str``, the name on the command line;
- ``HELP: str``, the line that ``gpusense --help`` shows;
- ``EPILOG: str``, shown verbatim at the end of its help;
- ``add_arguments(parser) -> None``, which may also set ``parser.description``;
- ``run(args) -> int``, which returns the exit code.

Importing a command module is cheap: backends, drawing and rich are imported on use. A ValueError, TypeError, OSError or
MemoryError of ``run`` is printed as one line on standard error.
"""
