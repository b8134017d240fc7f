"""The site has every page and every public name, and the programs of its tour run."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

import gpusense as gs

DOCS = ROOT / "docs"
TOUR = sorted((DOCS / "tour").glob("*.py"))


@pytest.fixture(scope="module")
def pages():
    """Return the module that writes the pages of public names."""
    spec = importlib.util.spec_from_file_location("reference_pages", DOCS / "reference_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_public_name_has_an_entry(pages, tmp_path):
    pages.write_pages(tmp_path / "api")
    text = "\n".join(file.read_text() for file in (tmp_path / "api").glob("*.rst"))
    entries = set(re.findall(r"^\.\. (?:autoclass|autofunction|py:data):: (\S+)$", text, re.MULTILINE))
    expected = {f"gpusense.{name}" for name in gs.__all__ if name != "__version__"}
    for module in gs._MODULES:
        expected |= {f"gpusense.{module}.{name}" for name in getattr(gs, module).__all__}
    assert entries == expected
    assert set(pages.rooms()) == set(pages.TITLES) and set(gs._MODULES) == set(pages.MODULES)


def test_pages_that_are_gone_are_removed(pages, tmp_path):
    (tmp_path / "gone.rst").write_text("Gone\n")
    pages.write_pages(tmp_path)
    assert not (tmp_path / "gone.rst").exists() and (tmp_path / "index.rst").exists()


def test_every_page_is_in_a_list_of_the_first():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    lists = re.findall(r"^```\{toctree\}\n(.*?)^```$", index, re.MULTILINE | re.DOTALL)
    listed = [line for each in lists for line in each.splitlines() if line and not line.startswith(":")]
    assert len(listed) == len(set(listed))
    assert {page.stem for page in DOCS.glob("*.md")} - {"index"} <= set(listed)


def test_pages_are_few_and_notes_stand_aside():
    """Long tables belong in bench, and dropped variants in dated notes."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    assert len(list(DOCS.glob("*.md"))) <= 20 and "notes/" not in index
    notes = list((DOCS / "notes").iterdir())
    assert notes and all(re.fullmatch(r"20\d\d-\d\d-\d\d-[a-z-]+\.md", note.name) for note in notes)


@pytest.mark.parametrize("program", TOUR, ids=lambda path: path.stem)
def test_a_program_of_the_tour_says_its_idea(program):
    head = program.read_text(encoding="utf-8").split('"""')[1]
    assert "**Try:**" in head and "==" in head and re.search(r"book|JAIR|ICRA", head)


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("sphinx_gallery")
    for name in ("bench", "docs", "examples", "gpusense", "kernels"):
        ignored = shutil.ignore_patterns("__pycache__", "lectures", "api")
        shutil.copytree(ROOT / name, tmp_path / name, ignore=ignored)
    for file in ROOT.iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-c", "docs", ".", "site"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "index.html").is_file()
    assert Path(tmp_path, "site", "docs", "lectures", "11_bayes_filter.html").is_file()
