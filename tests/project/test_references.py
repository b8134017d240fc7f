"""Files that comments, docstrings and pages name exist, and so do the targets of links and anchors."""

from __future__ import annotations

import ast
import functools
import io
import itertools
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

from support.paths import ROOT

import gpusense as gs

# Reports hold the commands of their day; folders of tools are no part of the project.
_LEFT_OUT = ("bench/results/", ".git/", ".venv/", "venv/", "build/", "dist/", "shared/", "site/", "htmlcov/")
_SOURCES = (".py", ".pyi", ".cl", ".md", ".toml", ".cpp")
# Scripts whose former names a page explains.
_FORMER = {"bench/RESULTS.md": {"speed.py", "several_scans.py", "work_items.py"}}
# Folders where a path may begin, apart from the folder of the file that names it.
_BASES = ("", "gpusense", "kernels", "kernels/opencl", "kernels/warp", "bench", "tests", "docs")
_ENDINGS = "py|pyi|cl|md|toml|cpp|svg|png|json|yaml|yml|xml|cfg"
_PATH = re.compile(rf"(?<![\w/.:<>{{}}*$~-])((?:[\w.-]+/)*[\w.-]*\w\.(?:{_ENDINGS})|(?:[\w.-]+/)+)(?![\w/*<{{-])")
_LINK = re.compile(
    r"!?\[[^\]]*\]\(\s*<?([^)\s>]+)>?[^)]*\)|^\s*\[[^\]]+\]:\s*(\S+)|(?:src|href)=\"([^\"]+)\"", re.MULTILINE
)


def every_file() -> dict[str, Path]:
    """Return the files of the checkout by their paths in it."""
    hidden = re.compile(r"(^|/)(__pycache__|\.(?!ci/|gitignore)[^/]*|[^/]*\.egg-info)(/|$)")
    found = {path.relative_to(ROOT).as_posix(): path for path in ROOT.rglob("*") if path.is_file()}
    return {
        name: path for name, path in found.items() if not name.startswith(_LEFT_OUT[1:]) and not hidden.search(name)
    }


FILES = every_file()
FOLDERS = {parent.as_posix() for name in FILES for parent in Path(name).parents}
NAMES = {Path(name).name for name in FILES}
READ = [name for name in FILES if name.endswith(_SOURCES) and not name.startswith(_LEFT_OUT[:1])] + [".ci/run"]
PAGES = [name for name in READ if name.endswith(".md")]


def prose(name: str, text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a file that are written for readers: comments, docstrings, pages.

    Commands after "Command:" are left out, since they are as they were run.
    """
    if name.endswith((".py", ".pyi")):
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string
        for node in ast.walk(ast.parse(text)):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                yield from enumerate(node.value.value.splitlines(), node.lineno)
        return
    mark = {".cl": "//", ".cpp": "//", ".md": ""}.get(Path(name).suffix, "#")
    for number, line in enumerate(text.splitlines(), 1):
        if mark in line:
            yield number, (line.split(mark, 1)[1] if mark else line).split("Command: ")[0]


def missing_paths(name: str, text: str) -> list[str]:
    """Return the paths that a file names and that the project lacks, with their places.

    A path with folders belongs to the project if its first folder exists in the root, in a usual base, or next to the
    file. A bare name is one if it ends as a source does. Few files have such a path at all, so most are not split into
    code and prose.
    """
    if not gone_in(name, enumerate(text.splitlines(), 1)):
        return []
    return gone_in(name, prose(name, text))


def gone_in(name: str, lines: Iterable[tuple[int, str]]) -> list[str]:
    """Return the missing paths of some lines of a file."""
    gone = []
    for number, line in lines:
        for match in _PATH.finditer(line):
            path = match.group(1).rstrip("/")
            here = Path(name).parent.as_posix()
            first = path.split("/")[0]
            bases = [Path(base) for base in (*_BASES, here)]
            if any(normal(base / path) in FILES or normal(base / path) in FOLDERS for base in bases):
                continue
            if "/" not in match.group(1):
                known = path in NAMES or not path.endswith((".py", ".pyi", ".cl")) or path in _FORMER.get(name, ())
            else:
                known = first in ("..", ".") or not any(normal(base / first) in FOLDERS for base in bases)
            if not known:
                gone.append(f"{name}:{number}: {path}")
    return gone


def normal(path: Path) -> str:
    """Return a path in the checkout without ``..``."""
    parts: list[str] = []
    for part in path.parts:
        if part == ".." and parts:
            parts.pop()
        elif part != ".":
            parts.append(part)
    return "/".join(parts)


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them, and those that it names itself."""
    found = set(re.findall(r"<a (?:id|name)=\"([^\"]+)\"", text))
    for line in without_blocks(text).splitlines():
        heading = re.match(r"#{1,6}\s+(.*?)\s*#*$", line)
        if heading:
            plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", heading.group(1))
            slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
            free = (f"{slug}-{k}" if k else slug for k in itertools.count())
            found.add(next(one for one in free if one not in found))
    return found


def without_blocks(text: str) -> str:
    """Return a page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def without_code(text: str) -> str:
    """Return a page without its blocks and spans of code, which hold no links."""
    return re.sub(r"`[^`\n]*`", "", without_blocks(text))


# Pages that the build of the site writes; tests/project/test_site.py looks for them.
_WRITTEN = {
    "docs/lectures/index.rst", "docs/api/index.rst",
    *(f"docs/front/figures/{name}.html" for name in ("beam", "em", "scan", "error-vs-time")),
}  # fmt: skip


def broken_links(name: str, text: str) -> list[str]:
    """Return the relative links of a page without a target."""
    broken = []
    for groups in _LINK.findall(without_code(text)):
        target = next(filter(None, groups))
        if re.match(r"[a-z][a-z+.-]*:", target):
            continue
        path, _, anchor = target.partition("#")
        file = normal(Path(name).parent / path) if path else name
        if file in _WRITTEN:
            continue
        if (file not in FILES and file not in FOLDERS) or (
            anchor and (not file.endswith(".md") or anchor not in anchors(FILES[file].read_text(encoding="utf-8")))
        ):
            broken.append(f"{name}: {target}")
    return broken


def test_paths_in_comments_docstrings_and_pages_exist():
    assert len(READ) > 700
    assert [gone for name in READ for gone in missing_paths(name, FILES[name].read_text(encoding="utf-8"))] == []


def test_links_and_anchors_of_pages_resolve():
    assert len(PAGES) > 20
    assert [link for name in PAGES for link in broken_links(name, FILES[name].read_text(encoding="utf-8"))] == []


def imported_names(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the modules of gpusense, and of bench, with the names that a script takes from them."""
    tree, modules = ast.parse(path.read_text(encoding="utf-8")), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)
            modules |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            yield modules[node.value.id], node.attr


@functools.cache
def defined_names(path: Path) -> set[str]:
    """Return the names at the top level of a script."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {name for node in ast.walk(tree) for name in (
        [node.id] if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        else [node.name] if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        else [alias.asname or alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom))
        else []
    )}  # fmt: skip


def test_names_that_bench_imports_exist():
    """Scripts that no test runs would notice a removed name only when somebody measures again."""
    missing, public = [], {*dir(gs), *gs.__all__}
    for path in sorted((ROOT / "bench").rglob("*.py")):
        for module, name in imported_names(path):
            places = [folder / module.replace(".", "/") for folder in (ROOT, ROOT / "bench", path.parent)]
            files = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
            if (file := next(filter(Path.is_file, files), None)) is None:
                # A module of a library, or a class.
                continue
            known = public if module == "gpusense" else defined_names(file)
            if name.startswith("__"):
                continue
            if name not in known and not any((place / f"{name}.py").is_file() for place in places):
                missing.append(f"{path.relative_to(ROOT)}: {module}.{name}")
    assert missing == []


def test_bench_scripts_import_their_helpers_after_finding_them():
    """A sorted import above ``sys.path.insert`` fails as soon as a script runs alone."""
    helpers, early = {path.stem for path in (ROOT / "bench").glob("*.py")}, []
    for path in sorted((ROOT / "bench").glob("*/*.py")):
        text = path.read_text(encoding="utf-8")
        found = text.find("sys.path.insert")
        for name in re.finditer(r"^(?:from|import) (\w+)", text[: max(found, 0)], re.MULTILINE):
            if name[1] in helpers:
                early.append(f"{path.relative_to(ROOT)}: {name[1]}")
    assert early == []
