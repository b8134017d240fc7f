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
            self.close()
            raise

    def __repr__(self) -> str:
        return f"Table({str(self.path)!r}, {len(self.rows)} rows, {len(self.columns)} columns)"

    def __enter__(self) -> Table:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def _load(self) -> None:
        """Read the rows, and cut off a torn last line."""
        self._stream.seek(0)
        data = self._stream.read()
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            self._stream.truncate(whole)
        self._stream.seek(0, os.SEEK_END)
        self.columns, rows = _parsed(data[:whole], self.path)
        self.rows = {row["key"]: row for row in rows}

    def add(self, job: Job, outcome: Outcome, attempts: int) -> Row:
        """Append the row of a job, and return it once the line is on the disk."""
        row = row_of(job, outcome, attempts)
        more = [name for name in row if name not in self.columns]
        self.rows[row["key"]] = row
        if more or not self.columns:
            middle = [name for name in (*self.columns, *row) if name not in (*FIRST, *LAST)]
            self._rewrite(self.rows.values(), (*FIRST, *dict.fromkeys(middle), *LAST))
        else:
            with naming(self.path):
                self._stream.write(_lines(self.columns, [row]))
                self._stream.flush()
                os.fsync(self._stream.fileno())
        return row

    def _rewrite(self, rows: Iterable[Row], columns: tuple[str, ...]) -> None:
        text = _lines(columns, [dict(zip(columns, columns, strict=True)), *rows])
        write_whole(self.path, lambda stream: stream.write(text))
        self._stream.close()
        self.columns, self._stream = columns, _opened(self.path)
        self._stream.seek(0, os.SEEK_END)

    def finish(self, keys: Sequence[str]) -> None:
        """Write the rows in plan order, then rows of unknown jobs, then the Parquet file."""
        if not self.columns:
            return
        ordered = [self.rows[key] for key in keys if key in self.rows]
        known = set(keys)
        ordered += [row for key, row in self.rows.items() if key not in known]
        self._rewrite(ordered, self.columns)
        if self.parquet is not None:
            pyarrow = _pyarrow()
            import pyarrow as arrow

            table = arrow.table(columns_of(self.columns, ordered))
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
    data = file.read_bytes()
    names, rows = _parsed(data[: data.rfind(b"\n") + 1], file)
    return columns_of(names, list({row["key"]: row for row in rows}.values()))


def columns_of(names: Sequence[str], rows: Sequence[Mapping[str, str]]) -> dict[str, list[Any]]:
    """Return the columns of rows as values: each column has one type, strings if the types of its cells differ."""
    columns: dict[str, list[Any]] = {}
    for name in names:
        cells = [row.get(name, "") for row in rows]
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
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (tuple, list)):
        return json.dumps(value)
    return " ".join(str(value).split()) if isinstance(value, str) else repr(value)


def _lines(columns: Sequence[str], rows: Iterable[Mapping[str, str]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([row.get(name, "") for name in columns] for row in rows)
    return text.getvalue().encode()


def _parsed(data: bytes, path: Path) -> tuple[tuple[str, ...], list[Row]]:
    """Return columns and rows of whole lines."""
    try:
        lines = list(csv.reader(io.StringIO(data.decode(), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: must be a CSV file, got {error}") from None
    if not lines:
        return (), []
    columns = tuple(lines[0])
    if columns[: len(FIRST)] != FIRST or columns[-len(LAST) :] != LAST or len(set(columns)) < len(columns):
        raise ValueError(f"{path}: must be the table of a sweep, got the columns {checks.show(lines[0])}")
    for number, cells in enumerate(lines[1:], 2):
        if len(cells) != len(columns):
            raise ValueError(f"{path}: every line must have {len(columns)} cells, got {len(cells)} in line {number}")
    return columns, [dict(zip(columns, cells, strict=True)) for cells in lines[1:]]


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
