"""The JSON tables of a nuScenes log, read row by row.

The full training set has 2.6 million rows in ``sample_data.json`` and as many in ``ego_pose.json``. So a table is
decoded from a sliding window, each row is reduced at once to the columns somebody reads, and rows nobody needs are
dropped on the spot: memory follows what is kept, not what the file holds (34,000 keyframes out of 2.6 million rows
take 40 s and 0.8 GB).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ..errors import Problem
from .names import is_file_name, is_plain_name

Row = dict[str, Any]

_WINDOW: Final = 1 << 22
_LONGEST_ROW: Final = 1 << 22
"""No nuScenes row comes near this many characters; a table that has one is not worth the memory."""
_SPACE: Final = " \t\r\n"


class TableError(ValueError):
    """A table is not a JSON list; the message says what it is instead."""


def is_token(value: object) -> bool:
    """A non-empty string."""
    return isinstance(value, str) and bool(value)


def is_text(value: object) -> bool:
    """A string, empty ones too."""
    return isinstance(value, str)


def is_integer(value: object) -> bool:
    """An integer that fits 64 bits; true and false are none."""
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1 << 63


def is_flag(value: object) -> bool:
    """True or false."""
    return isinstance(value, bool)


def is_list(value: object) -> bool:
    """A JSON list; what it holds is judged by whoever uses it."""
    return isinstance(value, list)


KIND: Final[Mapping[Callable[[object], bool], str]] = {
    is_token: "a non-empty string",
    is_file_name: "a plain name of at most 128 ASCII letters, digits and . _ + -",
    is_plain_name: "a plain name of at most 128 letters, digits, spaces and . _ + -",
    is_text: "a string",
    is_integer: "an integer",
    is_flag: "true or false",
    is_list: "a list",
}


@dataclass(frozen=True, slots=True)
class Table:
    """What a reader needs of one table.

    Attributes:
        name: the file is ``<name>.json``.
        columns: column name → the check its values must pass.
        optional: columns that may be absent or of another kind; None stands for such a value.
        required: whether a log without this table cannot be opened.
    """

    name: str
    columns: Mapping[str, Callable[[object], bool]]
    optional: Mapping[str, Callable[[object], bool]] = field(default_factory=dict)
    required: bool = True


def stream(path: Path) -> Iterator[Any]:
    """The elements of a JSON list in a file, one after the other.

    Raises:
        TableError: not UTF-8 JSON, not a list, truncated, or a row of absurd length.
        OSError: the file cannot be read.
    """
    decoder = json.JSONDecoder()
    with path.open(encoding="utf-8-sig") as file:
        try:
            buffer = file.read(_WINDOW).lstrip(_SPACE)
            if not buffer.startswith("["):
                raise TableError("it does not hold a JSON list" if buffer else "it is empty")
            position, first = 1, True
            while True:
                buffer, position, token = _next_token(file.read, buffer, position)
                if token == "]":
                    return
                if not first:
                    if token != ",":
                        raise TableError(f"row after row there should be a comma, not {token!r}")
                    buffer, position, token = _next_token(file.read, buffer, position + 1)
                first = False
                buffer, value, position = _decode(decoder, file.read, buffer, position)
                yield value
        except UnicodeDecodeError as error:
            raise TableError("it is not UTF-8 text") from error
        except RecursionError as error:
            raise TableError("it is nested too deeply") from error


def _next_token(read: Callable[[int], str], buffer: str, position: int) -> tuple[str, int, str]:
    while True:
        while position < len(buffer) and buffer[position] in _SPACE:
            position += 1
        if position < len(buffer):
            return buffer, position, buffer[position]
        buffer, position = read(_WINDOW), 0
        if not buffer:
            raise TableError("it ends in the middle: the file is truncated")


def _decode(decoder: json.JSONDecoder, read: Callable[[int], str], buffer: str, position: int) -> tuple[str, Any, int]:
    while True:
        try:
            value, end = decoder.raw_decode(buffer, position)
        except json.JSONDecodeError as error:
            problem = error
        except ValueError as error:  # an integer of thousands of digits
            raise TableError("it holds a number that is far too long") from error
        else:
            # Behind "1" the window may end, and the file go on with ".5"; a row ends with its brace.
            if end < len(buffer) and (isinstance(value, dict) or buffer[end] in _SPACE + ",]"):
                return buffer, value, end
            problem = json.JSONDecodeError("no comma or end of the list after a row", buffer, end)
        if len(buffer) - position > _LONGEST_ROW:
            raise TableError(f"it is not valid JSON ({problem.msg})")
        more = read(_WINDOW)
        if not more:
            raise TableError(f"it is truncated or not valid JSON ({problem.msg})")
        buffer, position = buffer[position:] + more, 0


def read_table(
    folder: Path, table: Table, problems: list[Problem], keep: Callable[[Row], bool] = lambda row: True
) -> list[Row]:
    """The rows of one table, reduced to the columns the table names.

    Args:
        folder: the version folder.
        table: which table and which columns.
        problems: what is wrong with the table is appended here, one problem a kind with a count.
        keep: rows for which this is False are dropped after their check.

    Returns:
        The sound rows, in file order. Empty when the table is missing or no JSON list.
    """
    path = folder / f"{table.name}.json"
    where = f"{folder.name}/{table.name}.json"
    rows: list[Row] = []
    faults: Counter[str] = Counter()
    first: dict[str, int] = {}
    number = 0
    try:
        for number, value in enumerate(stream(path), start=1):
            row, fault = _reduce(value, table)
            if row is None:
                faults[fault] += 1
                first.setdefault(fault, number)
            elif keep(row):
                rows.append(row)
    except FileNotFoundError:
        if table.required:
            problems.append(_broken("missing-table", where, "the table is missing"))
    except (TableError, OSError) as error:
        problems.append(_broken("bad-table", where, f"the table cannot be read: {error}"))
    for fault, count in faults.items():
        what = f"{count} of {number} rows {fault} (the first is row {first[fault]})"
        problems.append(_broken("bad-table", where, what))
    return rows


def _reduce(value: object, table: Table) -> tuple[Row | None, str]:
    if not isinstance(value, dict):
        return None, "are not JSON objects"
    row: Row = {}
    for column, check in table.columns.items():
        if column not in value:
            return None, f"have no '{column}'"
        if not check(value[column]):
            return None, f"have a '{column}' that is not {KIND[check]}"
        row[column] = value[column]
    for column, check in table.optional.items():
        entry = value.get(column)
        row[column] = entry if check(entry) else None
    return row, ""


def _broken(code: str, where: str, what: str) -> Problem:
    return Problem(code, where, what, "Export the nuScenes v1.0 tables again; all tables of a log belong together")


def unique(rows: list[Row], where: str, problems: list[Problem]) -> dict[str, Row]:
    """Rows by token; a token that two rows share is a problem, and the first row counts."""
    table: dict[str, Row] = {}
    doubled: Counter[str] = Counter()
    for row in rows:
        if table.setdefault(row["token"], row) is not row:
            doubled[row["token"]] += 1
    if doubled:
        token = next(iter(doubled))
        problems.append(
            Problem(
                "duplicate-token",
                where,
                f"{len(doubled)} token(s) occur in more than one row, the first of them {token}",
                "Give every row its own token",
            )
        )
    return table


def in_order(rows: list[Row]) -> tuple[list[Row], bool]:
    """Rows in the order of their ``prev``/``next`` links.

    Args:
        rows: rows with ``token``, ``timestamp``, ``prev`` and ``next``; tokens are unique.

    Returns:
        The rows, and True when the links formed one chain over all of them. Otherwise the order is by time stamp.
    """
    by_token = {row["token"]: row for row in rows}
    starts = [row for row in rows if row["prev"] not in by_token]
    chain: list[Row] = []
    row: Row | None = starts[0] if len(starts) == 1 else None
    while row is not None and len(chain) < len(rows):
        chain.append(row)
        row = by_token.get(row["next"] or "")
    if len({r["token"] for r in chain}) == len(rows):  # neither broken nor a circle
        return chain, True
    return sorted(rows, key=lambda r: int(r["timestamp"])), False


def finite_numbers(values: object, count: int) -> list[float] | None:
    """A JSON list of ``count`` finite numbers as floats, or None when it is something else."""
    if not isinstance(values, list) or len(values) != count:
        return None
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return None
    try:
        numbers = [float(v) for v in values]
    except OverflowError:
        return None
    return numbers if all(map(math.isfinite, numbers)) else None
