"""The table of a sweep: a CSV file to which whole lines are appended, and a Parquet file once the sweep ends.

A crash can leave a torn last line; opening the file again cuts it off. All other lines are complete.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from gpusense._util import checks
from gpusense._util.extras import library
from gpusense._util.files import naming, write_whole
from gpusense.sweeps.job import Job
from gpusense.sweeps.process import Outcome

Row = dict[str, str]
# Columns of every table, before the columns of options, labels and results.
FIRST = ("key", "status", "task", "map", "log", "model", "seed")
LAST = ("seconds", "cpu_seconds", "attempts", "worker", "device", "error")
DONE, FAILED = "done", "failed"
_INTEGER = re.compile(r"[-+]?\d{1,18}")


class Table:
    """Rows of finished jobs in a CSV file, and a Parquet file of the same name if the path ends in ``.parquet``.

    ``rows`` holds the last row of each key, as texts. Only ``resume`` accepts an existing file.
    """

    def __init__(self, path: str | os.PathLike[str], *, resume: bool = False) -> None:
        named = checks.path("table", path)
        if named.suffix not in (".csv", ".parquet"):
            raise ValueError(f"table: must end in .csv or .parquet, got {named}")
        self.parquet = named if named.suffix == ".parquet" else None
        self.path = named.with_suffix(".csv")
        if self.parquet is not None:
            _pyarrow()
        for one in {self.path, named} if not resume else ():
            if os.path.lexists(one):
                raise FileExistsError(f"table: {one} exists: resume it, or name another one")
        self.columns: tuple[str, ...] = ()
        self.rows: dict[str, Row] = {}
        self._stream = _opened(self.path)
        try:
            self._load()
        except BaseException:
            self._stream.close()
            raise

    def __enter__(self) -> Table:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def _load(self) -> None:
        """Read the rows, and cut off a torn last line."""
        self._stream.seek(0)
        data = self._stream.read()
        self.columns, self.rows = _parsed(data, self.path)
        self._stream.truncate(data.rfind(b"\n") + 1)

    def add(self, job: Job, outcome: Outcome, attempts: int) -> Row:
        """Append the row of a job, and return it once the line is on the disk."""
        row = row_of(job, outcome, attempts)
        self.rows[row["key"]] = row
        if not row.keys() <= set(self.columns):
            middle = [name for name in (*self.columns, *row) if name not in (*FIRST, *LAST)]
            self.columns = (*FIRST, *dict.fromkeys(middle), *LAST)
            self._rewrite()
        else:
            with naming(self.path):
                self._stream.write(_lines(self.columns, [row]))
                self._stream.flush()
                os.fsync(self._stream.fileno())
        return row

    def _rewrite(self) -> None:
        text = _lines(self.columns, [dict(zip(self.columns, self.columns, strict=True)), *self.rows.values()])
        write_whole(self.path, lambda stream: stream.write(text))
        self._stream.close()
        self._stream = _opened(self.path)

    def finish(self, keys: Sequence[str]) -> None:
        """Write the rows in plan order, then rows of unknown jobs, then the Parquet file."""
        if not self.columns:
            return
        self.rows = {key: self.rows[key] for key in dict.fromkeys((*keys, *self.rows)) if key in self.rows}
        self._rewrite()
        if self.parquet is not None:
            pyarrow = _pyarrow()
            table = library("pyarrow", "a Parquet table").table(_values(self.columns, self.rows))
            write_whole(self.parquet, lambda stream: pyarrow.write_table(table, stream))


def row_of(job: Job, outcome: Outcome, attempts: int) -> Row:
    """Return the cells of a job's row by column."""
    fields: dict[str, Any] = {
        "key": job.key, "status": FAILED if outcome.error else DONE, "task": job.task, "map": job.map, "log": job.log,
        "model": job.model, "seed": job.seed,
    }  # fmt: skip
    last = dict(
        seconds=round(outcome.seconds, 6), cpu_seconds=round(outcome.cpu_seconds, 6), attempts=attempts,
        worker=outcome.worker, device=outcome.device, error=outcome.error,
    )  # fmt: skip
    own = fields | job.by_name
    # A label that equals the value has no separate column.
    fields |= {f"axis.{name}": label for name, label in job.labels if own.get(name) != label}
    for kind, values in (("option", job.by_name), ("result", outcome.values)):
        for name, value in values.items():
            fields[f"{kind}.{name}" if name in fields or name in last else name] = value
    return {name: _text(value) for name, value in (fields | last).items()}


def read_table(path: str | os.PathLike[str]) -> dict[str, list[Any]]:
    """Read the table of a sweep, which may still be running.

    Args:
        path: A CSV or Parquet file of a sweep.

    Returns:
        The columns by name: numbers, booleans and strings; None without a value. The last row of a job counts.

    Raises:
        FileNotFoundError: the file is missing.
        ImportError: Parquet without pyarrow.
        ValueError: the file is no table.
    """
    file = checks.existing_file(checks.path("path", path))
    if file.suffix == ".parquet":
        columns: dict[str, list[Any]] = _pyarrow().read_table(file).to_pydict()
        return columns
    return _values(*_parsed(file.read_bytes(), file))


def _values(names: Sequence[str], rows: Mapping[str, Row]) -> dict[str, list[Any]]:
    """Return the columns of rows as values: each column has one type, strings if the types of its cells differ."""
    columns: dict[str, list[Any]] = {}
    for name in names:
        cells = [row.get(name, "") for row in rows.values()]
        values = [_value(cell) if name != "key" else cell for cell in cells]
        kinds = {type(value) for value in values if value is not None}
        if kinds == {int, float}:
            values = [None if value is None else float(value) for value in values]
        elif len(kinds) > 1:
            values = [None if value is None else cell for value, cell in zip(values, cells, strict=True)]
        columns[name] = values
    return columns


def _value(cell: str) -> Any:
    if cell == "":
        return None
    if cell in ("true", "false"):
        return cell == "true"
    if _INTEGER.fullmatch(cell):
        return int(cell)
    try:
        return float(cell)
    except ValueError:
        return cell


def _text(value: Any) -> str:
    """Format a cell on one line; numbers can be read back with all bits."""
    if value is None:
        return ""
    text = value if isinstance(value, str) else json.dumps(value, default=repr)
    return " ".join(text.split())


def _lines(columns: Sequence[str], rows: Iterable[Mapping[str, str]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([row.get(name, "") for name in columns] for row in rows)
    return text.getvalue().encode()


def _parsed(data: bytes, path: Path) -> tuple[tuple[str, ...], dict[str, Row]]:
    """Return the columns, and the last row of each key; a torn last line is left out."""
    try:
        lines = list(csv.reader(io.StringIO(data[: data.rfind(b"\n") + 1].decode(), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: must be a CSV file, got {error}") from None
    if not data:
        return (), {}
    if not lines:
        raise ValueError(f"{path}: must be the table of a sweep, got {checks.show(data[:40])}")
    columns = tuple(lines[0])
    if columns[: len(FIRST)] != FIRST or columns[-len(LAST) :] != LAST or len(set(columns)) < len(columns):
        raise ValueError(f"{path}: must be the table of a sweep, got the columns {checks.show(lines[0])}")
    for number, cells in enumerate(lines[1:], 2):
        if len(cells) != len(columns):
            raise ValueError(f"{path}: every line must have {len(columns)} cells, got {len(cells)} in line {number}")
    return columns, {cells[0]: dict(zip(columns, cells, strict=True)) for cells in lines[1:]}


def _opened(path: Path) -> BinaryIO:
    """Open a table for reading and appending, and lock it against other sweeps."""
    if os.path.lexists(path) and not path.is_file():
        raise ValueError(f"{path}: must be a regular file, got another kind")
    stream = path.open("a+b")
    with contextlib.suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            stream.close()
            raise OSError(f"table: must be written by one sweep at a time, got {path} of another one") from error
    return stream


def _pyarrow() -> Any:
    return library("pyarrow.parquet", "a Parquet table, in place of a .csv one,")
