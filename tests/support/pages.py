"""Run the blocks of a documentation page in order, in a temporary folder.

Python blocks share a namespace. Shell blocks with a command of gpusense run in this process; blocks that install or
start other programs are skipped. A YAML block whose first line is ``# name.yaml`` is written as that file. Comments of
Markdown hold hidden blocks, ``<!-- invisible-code-block: python`` or ``sh``, and ``<!-- skip: next "reason" -->``, as
Sybil has them.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from unittest import SkipTest, mock

from sybil.document import Document
from sybil.example import Example
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

from gpusense.commands import cli

_FILE = re.compile(r"# (\w[\w.-]*\.ya?ml)\b")


@dataclass
class PageRun:
    """Number of visible blocks of a page that ran, and that were skipped."""

    ran: int = 0
    skipped: int = 0


def commands(text: str) -> list[list[str]]:
    """Return the arguments of each command of a shell block, without comments; lines that end in a backslash go on."""
    lines = re.sub(r"\\\n", " ", text).splitlines()
    return [arguments for line in lines if (arguments := shlex.split(line, comments=True))]


def is_ours(text: str) -> bool:
    """Return whether a shell block holds a command of gpusense, by its bare name."""
    return any(arguments[0] == "gpusense" for arguments in commands(text))


def run_shell(example: Example) -> str | None:
    """Run a block's commands in this process; return what failed, or None."""
    for program, *arguments in commands(example.parsed):
        if program != "gpusense":
            return f"a block with commands of gpusense must hold nothing else, got {program}"
        code = cli.main(arguments)
        if code != 0:
            return f"exit code {code}: gpusense {shlex.join(arguments)}"
    return None


def write_yaml(example: Example) -> None:
    """Write a block as the file that its first line names."""
    name = _FILE.match(example.parsed)
    if name:
        Path(name.group(1)).write_text(example.parsed, encoding="utf-8")


def parsed(page: Path) -> Document:
    """Parse a page; blocks of other programs' commands are no examples."""
    shell = CodeBlockParser("sh", run_shell)
    document = Document.parse(str(page), PythonCodeBlockParser(), CodeBlockParser("yaml", write_yaml), SkipParser())
    for region in shell(document):
        if is_ours(region.parsed):
            document.add(region)
    return document


def visible(example: Example) -> bool:
    """Return whether an example is a visible block to run."""
    text = example.document.text[example.region.start : example.region.end]
    return re.match(r"\s*(`{3,}|~{3,})(python|sh)\b", text) is not None


def run_page(page: Path, folder: Path) -> PageRun:
    """Run a page's blocks in a folder, and count them."""
    run = PageRun()
    document = parsed(page)
    document.namespace["__name__"] = "__main__"  # as for a program
    with contextlib.chdir(folder), mock.patch.dict(os.environ):
        for example in document.examples():
            try:
                example.evaluate()
            except SkipTest:
                run.skipped += visible(example)
            else:
                run.ran += visible(example)
    return run
