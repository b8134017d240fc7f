"""The commands of ``gpusense``, one module each.

A command module has

- optionally ``DESCRIPTION: str``, which its help shows in place of its line in :data:`gpusense.commands.cli.COMMANDS`;
- ``FIRST``, the options that lead its help, and ``SHARED``, its options of :data:`gpusense.commands.arguments.SHARED`;
- ``EPILOG: str``, the end of its help, with examples, and optionally ``CODES``, meanings of exit codes;
- ``add_options(add) -> None``, which adds further options by :class:`gpusense.commands.arguments.Options`;
- ``run(args) -> int``, which returns the exit code.

Only the module of the chosen command is imported; drawing and rich are imported on use. A ValueError, TypeError,
OSError or MemoryError of ``run`` is printed as one line on standard error.
"""
