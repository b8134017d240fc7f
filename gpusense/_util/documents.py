"""Read YAML documents within bounds, without executing their contents; convert values for JSON documents."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gpusense._util import checks

_LARGEST_YAML_BYTES = 1 << 20
DEEPEST = 100
"""Largest depth of nested lists and mappings."""
MOST_REPEATED = 100_000
"""Most values repeated by aliases of a document, counted as if written out."""
_TOO_DEEP = f"its parts must be nested at most {DEEPEST} deep, got more"


@functools.cache
def _base() -> Any:
    """Return PyYAML's safe loader, compiled if available."""
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@functools.cache
def _loader() -> Any:
    """Return the safe loader with decimal numbers.

    YAML 1.1 reads 010 as octal and 1:30 as sexagesimal. ROS reads them by YAML 1.2, with yaml-cpp, as ten and as
    text.
    """

    class DecimalLoader(_base()):  # type: ignore[misc]
        pass

    def decimal(loader: Any, node: Any) -> Any:
        text = loader.construct_scalar(node)
        if ":" in text:
            return text
        if re.fullmatch("[-+]?0[0-9_]+", text):
            return int(text.replace("_", ""))
        construct = "construct_yaml_float" if node.tag.endswith("float") else "construct_yaml_int"
        return getattr(loader, construct)(node)

    # PyYAML reads 08 as text.
    DecimalLoader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile("[-+]?0[0-9_]+$"), list("-+0"))
    for kind in ("int", "float"):
        DecimalLoader.add_constructor(f"tag:yaml.org,2002:{kind}", decimal)
    return DecimalLoader


def check_yaml(text: str | bytes) -> None:
    """Refuse YAML with parts that are nested too deeply, contain themselves, or grow without bound by aliases.

    Only the parser's events are read, so that aliases are never expanded.
    """
    import yaml

    nested: list[tuple[str | None, int]] = []
    known: dict[str, int] = {}
    size = repeated = 0
    for event in _events(text):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = nested.pop()
            if anchor is not None:
                known[anchor] = size
            size += before
            continue
        size += 1
        if isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in nested):
                raise ValueError(f"no part may contain itself, got *{event.anchor} within &{event.anchor}")
            part = known.get(str(event.anchor), 0)
            size, repeated = size + part, repeated + part
            if repeated > MOST_REPEATED:
                raise ValueError(f"its aliases must repeat at most {MOST_REPEATED} values, got more")
        elif isinstance(event, yaml.CollectionStartEvent):
            if len(nested) == DEEPEST:
                raise ValueError(_TOO_DEEP)
            nested.append((event.anchor, size))
            size = 0
        elif isinstance(event, yaml.ScalarEvent) and event.anchor is not None:
            known[event.anchor] = 1


def _events(text: str | bytes) -> Iterator[Any]:
    """Return the events of a document; some versions of the parser also limit nesting."""
    import yaml

    try:
        yield from yaml.parse(text, _base())
    except yaml.YAMLError as error:
        if "nesting depth" in str(getattr(error, "problem", "")):
            raise ValueError(_TOO_DEEP) from error
        raise


def read_mapping(file: Path) -> dict[Any, Any]:
    """Read the mapping in a YAML file of plain values; numbers are decimal."""
    import yaml

    with file.open("rb") as stream:
        text = stream.read(_LARGEST_YAML_BYTES + 1)
    if len(text) > _LARGEST_YAML_BYTES:
        raise ValueError(f"{file}: must be a YAML file of at most {_LARGEST_YAML_BYTES} bytes, got a larger file")
    try:
        check_yaml(text)
        loader = _loader()(text)
        try:
            root = loader.get_single_node()
            _check_keys(loader, root)
            data = None if root is None else loader.construct_document(root)
        finally:
            loader.dispose()
    except (yaml.YAMLError, ValueError, RecursionError, AttributeError, KeyError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise ValueError(f"{file}: must be plain YAML, got an error{line}: {_problem(error)}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{file}: must hold a YAML mapping, got {checks.show(data)}")
    return data


def _check_keys(loader: Any, root: Any) -> None:
    """Refuse mappings with a doubled key; PyYAML would silently keep its last value."""
    import yaml

    nodes, seen = [root], set[int]()
    while nodes:
        node = nodes.pop()
        if not isinstance(node, yaml.CollectionNode) or id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            nodes += node.value
            continue
        lines: dict[Any, int] = {}
        for key, value in node.value:
            nodes += (key, value)
            if isinstance(key, yaml.ScalarNode) and not key.tag.endswith(":merge"):
                name = loader.construct_object(key)
                if name in lines:
                    problem = f"the key {checks.show(name)} is doubled, first in line {lines[name]}"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                lines[name] = key.start_mark.line + 1


def _problem(error: Exception) -> str:
    """Return the parsing library's text of an error."""
    for name in ("problem", "reason"):
        if text := getattr(error, name, None):
            return " ".join(str(text).split())
    return str(error) if type(error) is ValueError and str(error) else type(error).__name__


def plain(value: Any, digits: int | None = None) -> Any:
    """Convert a value to JSON's types.

    Dataclasses become mappings, NumPy's scalars and arrays numbers and lists, NaN and infinities None.

    ``digits``: Significant digits to which numbers are rounded; None for all.
    """
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist(), digits)
    if isinstance(value, (list, tuple)):
        return [plain(item, digits) for item in value]
    if isinstance(value, float):
        shown = value if digits is None else float(f"{value:.{digits}g}")
        return shown if math.isfinite(value) else None
    return str(value) if isinstance(value, os.PathLike) else value
