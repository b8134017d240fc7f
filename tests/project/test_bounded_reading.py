"""Bounded functions read every document, compressed file and image of a user; exceptions have a reason."""

from __future__ import annotations

import ast
import re

from support.paths import ROOT

# Calls that read without a bound, or execute the contents.
CALLS = {
    "yaml": ("load", "load_all", "safe_load", "safe_load_all", "full_load", "unsafe_load", "compose"),
    "json": ("load", "loads"), "gzip": ("open", "GzipFile", "decompress"), "zlib": ("decompress",),
    "bz2": ("open", "BZ2File", "decompress"), "lzma": ("open", "decompress"), "Image": ("open",), "np": ("load",),
    "pickle": ("load", "loads"), "marshal": ("loads",), "tarfile": ("open",), "zipfile": ("ZipFile",),
}  # fmt: skip
ALLOWED = {
    "_util/documents.py": {"yaml.load": "checked by check_yaml before"},
    "_util/lines.py": {"gzip.open": "lines and bytes are counted"},
    "tables/lookup_files.py": {"json.loads": "of a first line of at most 4096 bytes"},
    "backends/cache.py": {"zipfile.ZipFile": "sizes are bounded before anything is unpacked"},
    "backends/proof.py": {"json.loads": "what this package wrote to its cache"},
    "backends/probe_process.py": {"json.loads": "what this package's own process said"},
    "backends/opencl/drivers.py": {"json.loads": "what this package's own process said"},
    "logs/carmen.py": {"gzip.GzipFile": "only to write"},
    "sweeps/process.py": {"pickle.loads": "jobs and results of this package's own processes, by pipes"},
}


def unbounded(text: str) -> set[str]:
    """Return the calls of the table in a source."""
    found: set[str] = set()
    # Trees of all files take long; most files name no such module.
    if not re.search(rf"\b({'|'.join(CALLS.keys() - {'np'})}|np\.load)\b", text):
        return found
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in CALLS.get(node.value.id, ()):
                found.add(f"{node.value.id}.{node.attr}")
        elif isinstance(node, ast.ImportFrom):
            names = [f"{(node.module or '').split('.')[-1]}.{alias.name}" for alias in node.names]
            found |= {name for name in names if name.split(".")[1] in CALLS.get(name.split(".")[0], ())}
    return found


def test_only_functions_with_bounds_read_documents_and_compressed_files():
    package = ROOT / "gpusense"
    found = {path.relative_to(package).as_posix(): unbounded(path.read_text(encoding="utf-8"))
             for path in package.rglob("*.py")}  # fmt: skip
    allowed = {name: set(calls) for name, calls in ALLOWED.items()}
    extra = {name: calls - allowed.get(name, set()) for name, calls in found.items()}
    assert {name: calls for name, calls in extra.items() if calls} == {}
