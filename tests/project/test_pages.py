"""Blocks of README.md and of the pages run as printed, in order, in an empty folder."""

from __future__ import annotations

import pytest
from support.pages import commands, is_ours, parsed, run_page, visible
from support.paths import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Pages whose blocks take seconds.
DEAR = ("README", "getting-started", "landmarks", "learning", "localization", "logs", "matching", "speed", "sweeps")


def name_of(page):
    """Return a page's path in the project."""
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.long) if page.stem in DEAR else page for page in PAGES], ids=name_of
)
def test_blocks_run(page, tmp_path, needs):
    needs("opencl")
    needs("warp")
    run_page(page, tmp_path)


# At most one block in this number may be skipped, also under a condition.
SKIPPED = 20


def test_few_blocks_are_skipped():
    examples = [example for page in PAGES for example in parsed(page).examples()]
    blocks = sum(map(visible, examples))
    skips = sum(isinstance(example.parsed, tuple) for example in examples)
    assert blocks > 45
    assert 0 < skips <= blocks / SKIPPED


SHELL = 'gpusense fit --map map.yaml \\\n    --out "a b"  # a comment\n\ngpusense devices\n'


def test_commands_of_a_shell_block():
    assert commands(SHELL) == [["gpusense", "fit", "--map", "map.yaml", "--out", "a b"], ["gpusense", "devices"]]
    assert is_ours(SHELL) and not is_ours("pip install gpusense\n")


FAULTS = {
    "a name that no block defines": ("```python\nx = y\n```\n", "name 'y' is not defined"),
    "a bad command": ("```sh\ngpusense map --log none.log --out m.yaml\n```\n", "exit code 2: gpusense map"),
    "another program": ("```sh\ngpusense devices --json\nls\n```\n", "must hold nothing else, got ls"),
    "a hidden block": ("<!-- invisible-code-block: python\nraise ValueError('seen')\n-->\n", "seen"),
    "after a skip": ('<!-- skip: next "why" -->\n\n```python\n1 / 0\n```\n\n```python\n[][1]\n```\n', "out of range"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_block_that_fails_is_found(name, tmp_path):
    text, message = FAULTS[name]
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(Exception, match=message):
        run_page(page, tmp_path)


def test_blocks_share_names_and_files(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```yaml\n# a.yaml\nb: 1\n```\n<!-- invisible-code-block: python\ntext = open('a.yaml').read()\n-->\n"
        "```python\nassert __name__ == '__main__'\n```\n"
        "```python\nassert text == '# a.yaml\\nb: 1\\n'\n```\n```sh\nls none\n```\n"
        '<!-- skip: next "why" -->\n\n```python\n1 / 0\n```\n'
    )
    run = run_page(page, tmp_path)
    assert (run.ran, run.skipped) == (2, 1)
