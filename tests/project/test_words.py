"""Docstrings, comments, messages and pages use plain words; See CONTRIBUTING.md for the rules."""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = next(folder for folder in Path(__file__).resolve().parents if (folder / "pyproject.toml").is_file())

SCANNED = ("gpusense", "kernels", "docs", "README.md", "CHANGELOG.md", "CONTRIBUTING.md")
# Folders of which code is scanned, but not pages: reports are as they were written.
CODE = ("bench", "examples", "tests")
# Files that hold banned words on purpose.
LEFT_OUT = ("tests/project/test_words.py",)

BANNED = re.compile(r"\b(told|mend|mends|mended|mending|so\s+many|nobody)\b", re.IGNORECASE)
# Pages say "also" before the verb.
TOO = re.compile(r", too(?=[.;:])")
# Sentences with a clause as their subject; a question may begin so.
CLAUSE = re.compile(r"(What|Who|That\s+of|Of\s+which)\b")
END = re.compile(r"[.!?:|](?=\s|[\"']|$)|\n\s*\n|\n\s*(?:[-*]|#+|\d+\.)\s")
# Quotes, prefixes of strings, list items and headings before a sentence's first word.
BEFORE = " \t\n\"'`*#|-_()"


def python_passages(text: str) -> Iterator[tuple[int, str]]:
    """Yield the first line and the text of each string and of each block of comments."""
    comment: list[str] = []
    last = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        kind = tokenize.tok_name[token.type]
        if kind == "COMMENT":
            if comment and token.start[0] != last + 1:
                yield last - len(comment) + 1, "\n".join(comment)
                comment = []
            last = token.start[0]
            comment.append(token.string.removeprefix("#"))
        elif kind in ("STRING", "FSTRING_MIDDLE"):
            yield token.start[0], token.string
    if comment:
        yield last - len(comment) + 1, "\n".join(comment)


def opencl_passages(text: str) -> Iterator[tuple[int, str]]:
    """Yield the first line and the text of each block of comments."""
    for match in re.finditer(r"/\*.*?\*/|//[^\n]*(?:\n[ \t]*//[^\n]*)*", text, re.DOTALL):
        yield text.count("\n", 0, match.start()) + 1, re.sub(r"//|/\*|\*/", "", match.group())


def page_passages(text: str) -> Iterator[tuple[int, str]]:
    """Yield a page without its blocks of code."""
    yield 1, re.sub(r"(?ms)^```.*?^```$", lambda match: "\n" * match.group().count("\n"), text)


PASSAGES = {".py": python_passages, ".cl": opencl_passages, ".md": page_passages}


def sentences(passage: str) -> Iterator[tuple[int, str, str]]:
    """Yield where each sentence begins, the sentence, and the sign that ends it."""
    begin = 0
    for end in [*END.finditer(passage), None]:
        stop = len(passage) if end is None else end.start()
        sentence = passage[begin:stop]
        text = sentence.lstrip(BEFORE)
        yield begin + len(sentence) - len(text), text, "" if end is None else end.group().strip()
        begin = stop if end is None else end.end()


def findings(passage: str) -> Iterator[tuple[int, str]]:
    """Yield the offset and the text of each banned word and sentence."""
    for match in BANNED.finditer(passage):
        yield match.start(), " ".join(match.group().split())
    for begin, text, end in sentences(passage):
        if end != "?" and CLAUSE.match(text):
            yield begin, " ".join(text.split())[:50]


def scanned_files() -> list[Path]:
    """Return the files to scan."""
    files = []
    for name in (*SCANNED, *CODE):
        path, kinds = ROOT / name, PASSAGES.keys() - ({".md"} if name in CODE else set())
        files += [path] if path.is_file() else [file for file in sorted(path.rglob("*")) if file.suffix in kinds]
    return [file for file in files if file.relative_to(ROOT).as_posix() not in LEFT_OUT]


def test_prose_has_no_banned_words():
    # Tokens of Python take long: files without a banned word anywhere are not divided into passages.
    found = [
        f"{file.relative_to(ROOT).as_posix()}:{line + passage.count(chr(10), 0, offset)}: {words}"
        for file in scanned_files()
        for text in [file.read_text(encoding="utf-8")]
        if BANNED.search(re.sub("#|//", " ", text)) or CLAUSE.search(re.sub("#|//", " ", text))
        for line, passage in PASSAGES[file.suffix](text)
        for offset, words in findings(passage)
    ]
    assert not found, "\n".join(["banned words, see CONTRIBUTING.md:", *found])


def test_no_sentence_of_a_page_ends_with_too():
    """Notes and the changelog are also pages."""
    found = [
        f"{file.relative_to(ROOT).as_posix()}:{text.count(chr(10), 0, match.start()) + 1}"
        for file in scanned_files()
        if file.suffix == ".md"
        for text in [file.read_text(encoding="utf-8")]
        for match in TOO.finditer(text)
    ]
    assert found == [] and TOO.search("as on one device, too.") and not TOO.search("also, too many. Too")
