"""Columns and schemas of tables, and how a notebook shows a table."""

from __future__ import annotations

import datetime
import html
import operator
import unicodedata
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, SupportsIndex, overload

from ._native import Table

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

SHOWN_ROWS = 5
"""How many rows of a long table a notebook shows at its beginning, and as many at its end."""

ROWS_AT_A_TIME = 4096


class Column:
    """A column of a table. Anything that supports Arrow's PyCapsule interface takes it without copying, and NumPy and Matplotlib take it as an array.

    Its values are those of `to_list`: times are integers of nanoseconds since 1970, and where there is no value there is `None`.
    """

    def __init__(self, table: Table, name: str) -> None:
        self._table = table
        self.name = name
        """Its name in the table."""

    @property
    def type(self) -> str:
        """Its type, such as `float64`."""
        return self._table.schema[self.name]

    @property
    def metadata(self) -> dict[str, str]:
        """Its unit, its description."""
        return self._table.column_metadata(self.name)

    def to_list(self) -> list[Any]:
        """The values."""
        return self._table._values(self.name)

    def to_numpy(self) -> np.ndarray[Any, Any]:
        """The values as `Table.to_numpy` has them: missing ones are masked."""
        return self._table.to_numpy()[self.name]

    def to_pyarrow(self) -> pa.ChunkedArray:
        """The same column for pyarrow."""
        return self._table.to_pyarrow().column(self.name)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray[Any, Any]:
        import numpy as np

        values = self.to_numpy()
        # An ordinary array has no mask: what is missing must not look like a value.
        if np.ma.is_masked(values):
            values = np.ma.filled(values.astype(float) if values.dtype.kind in "biu" else values, _missing(values.dtype.kind))
        return np.asarray(values, dtype=dtype)

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        # Of the column itself, not of a table with one column.
        return self.to_pyarrow().__arrow_c_stream__(requested_schema)

    def __len__(self) -> int:
        return len(self._table)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.to_list())

    @overload
    def __getitem__(self, rows: slice) -> Column: ...
    @overload
    def __getitem__(self, rows: SupportsIndex) -> Any: ...
    def __getitem__(self, rows: slice | SupportsIndex) -> Any:
        if isinstance(rows, slice):
            return Column(self._table[rows], self.name)
        row = range(len(self))[rows]
        return self._table[row : row + 1]._values(self.name)[0]

    def __repr__(self) -> str:
        return f"<cantap.Column {self.name!r} of {len(self)} rows, {self.type}>"


def _missing(kind: str) -> Any:
    import numpy as np

    return {"M": np.datetime64("NaT"), "O": None}.get(kind, float("nan"))


class Row(Mapping[str, Any]):
    """A row of a table: `row["id"]` or `row.id`. Values are those of `Column.to_list`: times are integers of nanoseconds since 1970, and where
    there is no value there is `None`.
    """

    __slots__ = ("_names", "_values")

    def __init__(self, names: tuple[str, ...], values: tuple[Any, ...]) -> None:
        self._names = names
        self._values = values

    def __getitem__(self, name: str) -> Any:
        try:
            return self._values[self._names.index(name)]
        except ValueError:
            raise KeyError(f"there is no column {name!r}; there are {', '.join(self._names)}") from None

    def __getattr__(self, name: str) -> Any:
        # While a copy is made there are no names yet.
        if name.startswith("_") or name not in self._names:
            raise AttributeError(f"there is no column {name!r}")
        return self[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._names)

    def __reduce__(self) -> tuple[type[Row], tuple[tuple[str, ...], tuple[Any, ...]]]:
        return (Row, (self._names, self._values))

    def __repr__(self) -> str:
        return f"<cantap.Row {' '.join(_shown(name, value) for name, value in self.items() if value is not None)}>"


def _shown(name: str, value: Any) -> str:
    if isinstance(value, bytes):
        return f"{name}={value.hex().upper()}"
    # Identifiers as everywhere else.
    return f"{name}={value:X}" if name == "id" and isinstance(value, int) else f"{name}={value!r}"


def rows(table: Table) -> Iterator[Row]:
    """The rows in order. Those of a batch are made at a time, so that a large table does not take its memory twice."""
    for batch in table.batches():
        for start in range(0, len(batch), ROWS_AT_A_TIME):
            yield from _rows_of(batch[start : start + ROWS_AT_A_TIME])


def row(table: Table, at: SupportsIndex) -> Row:
    """A row by its number from 0, or from the end if it is negative."""
    place = operator.index(at)
    place += len(table) if place < 0 else 0
    if not 0 <= place < len(table):
        raise IndexError(f"there is no row {operator.index(at)}: the table has {len(table)}")
    return next(_rows_of(table[place : place + 1]))


def _rows_of(table: Table) -> Iterator[Row]:
    names = table.column_names
    return (Row(names, values) for values in zip(*(table._values(name) for name in names)))


class Schema(Mapping[str, str]):
    """The columns of a table by name, each with its type; a schema for anything that takes Arrow's."""

    def __init__(self, table: Table, types: dict[str, str]) -> None:
        self._table = table
        self._types = types

    def __getitem__(self, name: str) -> str:
        return self._types[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._types)

    def __len__(self) -> int:
        return len(self._types)

    def __arrow_c_schema__(self) -> object:
        return self._table.__arrow_c_schema__()

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._types)

    def __repr__(self) -> str:
        return "\n".join(f"{name}: {kind}" for name, kind in self._types.items())


def to_html(table: Table) -> str:
    """A table for a notebook: its first and its last rows."""
    rows = len(table)
    names = list(table.column_names)
    is_whole = rows <= 2 * SHOWN_ROWS
    parts = [table] if is_whole else [table[:SHOWN_ROWS], table[rows - SHOWN_ROWS :]]
    lines = [f"<p>cantap.Table of {rows} rows</p>", "<table>", "<thead><tr>"]
    lines += [f"<th title={_quoted(table.schema[name])}>{_clean(name)}</th>" for name in names]
    lines.append("</tr></thead><tbody>")
    for at, part in enumerate(parts):
        if at:
            lines.append("<tr>" + len(names) * "<td>…</td>" + "</tr>")
        columns = [[_cell(value, table.schema[name]) for value in part._values(name)] for name in names]
        lines += ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in zip(*columns)]
    return "\n".join([*lines, "</tbody></table>"])


def messages_to_html(messages: Mapping[str, Table]) -> str:
    """A decoded trace for a notebook: its messages, with their signals."""
    lines = [f"<p>cantap.Messages: {len(messages)} messages</p>", "<table>", "<thead><tr><th>message</th><th>rows</th><th>signals</th></tr></thead><tbody>"]
    for name, table in messages.items():
        signals = ", ".join(_clean(column) for column in table.column_names[3:])
        lines.append(f"<tr><td>{_clean(name)}</td><td>{len(table)}</td><td>{signals}</td></tr>")
    return "\n".join([*lines, "</tbody></table>"])


def _cell(value: Any, kind: str) -> str:
    if value is None:
        return ""
    if kind.startswith("timestamp"):
        seconds, ns = divmod(value, 10**9)
        return f"{datetime.datetime(1970, 1, 1) + datetime.timedelta(seconds=seconds)}.{ns:09}"
    if isinstance(value, bytes):
        return value.hex(" ").upper()
    return _clean(str(value))


def _clean(text: str) -> str:
    """Texts come out of files and databases of others."""
    visible = "".join("\N{REPLACEMENT CHARACTER}" if unicodedata.category(letter)[0] == "C" else letter for letter in text)
    return html.escape(visible)


def _quoted(text: str) -> str:
    return f'"{_clean(text)}"'
