"""Traces as a dataset of pyarrow: DuckDB queries it, and Polars scans it. Columns, signals and times are chosen where files are read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset

from . import _native
from ._bounds import Bounds, bounds
from ._native import Database, Scan
from ._sources import TraceFile

if TYPE_CHECKING:
    import polars as pl

    from ._native import Options

Columns = Sequence[str] | Mapping[str, pc.Expression] | None

ROWS = 65_536
NOT_SIGNALS = ("time", "channel", "id")


class Dataset(pyarrow.dataset.Dataset):  # type: ignore[misc]
    """Traces that are read whenever somebody asks for rows; made by `cantap.dataset`.

    Anything that takes a dataset of pyarrow takes it. A filter's bounds on `time`, and the signals that it names or whose columns are
    wanted, are applied while the files are read; whatever else it says, after that.
    """

    def __init__(self, files: list[TraceFile], options: Options, message: str | None) -> None:
        # The base class cannot be made from Python; what it offers is overridden.
        self._files = files
        self._options = options
        self._message = message
        self._filter: pc.Expression | None = None
        self._schema = self._read_schema()

    @property
    def schema(self) -> pa.Schema:
        """The columns."""
        return self._schema

    @property
    def files(self) -> list[str]:
        """The files' names."""
        return [file[0] if isinstance(file, tuple) else str(file) for file in self._files]

    def to_batches(
        self, columns: Columns = None, filter: pc.Expression | None = None, batch_size: int = ROWS, **_options: Any
    ) -> Iterator[pa.RecordBatch]:
        """The rows that pass the filter, batch by batch. Memory does not grow with the files; with `message`, only with the largest."""
        filter = self._with_own(filter)
        wanted = bounds(filter, self._schema)
        needed = self._needed(columns, filter)
        for batch in self._batches(wanted, needed, batch_size):
            table = pa.Table.from_batches([batch])
            if filter is not None:
                table = table.filter(filter)
            if columns is not None:
                table = _projected(table, columns)
            yield from table.to_batches(max_chunksize=batch_size)

    def to_table(self, columns: Columns = None, filter: pc.Expression | None = None, **options: Any) -> pa.Table:
        """All of them as one table."""
        schema = self._projected_schema(columns)
        return pa.Table.from_batches(self.to_batches(columns, filter, **options), schema)

    def scanner(self, columns: Columns = None, filter: pc.Expression | None = None, **options: Any) -> pyarrow.dataset.Scanner:
        """What pyarrow and DuckDB read from."""
        allowed = {name: options[name] for name in ("batch_size",) if options.get(name) is not None}
        batches = self.to_batches(columns, filter, **allowed)
        return pyarrow.dataset.Scanner.from_batches(batches, schema=self._projected_schema(columns))

    def head(self, num_rows: int, columns: Columns = None, filter: pc.Expression | None = None, **options: Any) -> pa.Table:
        """The first rows."""
        batches, left = [], num_rows
        for batch in self.to_batches(columns, filter, **options):
            batches.append(batch.slice(0, left))
            left -= len(batches[-1])
            if left <= 0:
                break
        return pa.Table.from_batches(batches, self._projected_schema(columns))

    def count_rows(self, filter: pc.Expression | None = None, **options: Any) -> int:
        """How many pass the filter."""
        return sum(len(batch) for batch in self.to_batches(["time"], filter, **options))

    def to_polars(self) -> pl.LazyFrame:
        """The same for Polars, which asks for no more columns and rows than a query needs."""
        import polars as pl

        return pl.scan_pyarrow_dataset(self)

    def __reduce__(self) -> Any:
        return (_remade, (self._files, self._options, self._message, self._filter))

    def __repr__(self) -> str:
        what = f" of {self._message}" if self._message else ""
        return f"<cantap.Dataset{what} in {len(self._files)} files: {', '.join(self._schema.names)}>"

    def filter(self, expression: pc.Expression) -> Dataset:
        """The same with only the rows that pass."""
        filtered = Dataset.__new__(Dataset)
        filtered.__dict__.update(self.__dict__)
        filtered._filter = self._with_own(expression)
        return filtered

    def _with_own(self, filter: pc.Expression | None) -> pc.Expression | None:
        if self._filter is None or filter is None:
            return filter if self._filter is None else self._filter
        return self._filter & filter

    # What else the base class has works on a table in memory: its own methods would use what is not there.

    @property
    def partition_expression(self) -> pc.Expression:
        """True: no column is known from a file's name."""
        return pc.scalar(True)

    def take(self, indices: Any, columns: Columns = None, filter: pc.Expression | None = None, **options: Any) -> pa.Table:
        """Some of the rows, by their numbers."""
        return self.to_table(columns, filter, **options).take(indices)

    def sort_by(self, sorting: Any, **options: Any) -> pyarrow.dataset.InMemoryDataset:
        """The rows in another order, in memory."""
        return pyarrow.dataset.InMemoryDataset(self.to_table().sort_by(sorting, **options))

    def join(self, *arguments: Any, **options: Any) -> pyarrow.dataset.InMemoryDataset:
        """Joined with another dataset, in memory."""
        return pyarrow.dataset.InMemoryDataset(self.to_table()).join(*arguments, **options)

    def join_asof(self, *arguments: Any, **options: Any) -> pyarrow.dataset.InMemoryDataset:
        """Joined with the last row before each time of another dataset, in memory."""
        return pyarrow.dataset.InMemoryDataset(self.to_table()).join_asof(*arguments, **options)

    def get_fragments(self, filter: pc.Expression | None = None) -> Iterator[Any]:
        raise NotImplementedError("files of traces are no fragments; use to_batches")

    def replace_schema(self, schema: pa.Schema) -> Any:
        raise NotImplementedError("the columns of traces are what they are; cast what to_table returns")

    # What is read

    def _read_schema(self) -> pa.Schema:
        db = self._options["db"]
        if self._message is None:
            with Scan({**self._options, "files": self._files[:1]}, ROWS) as scan:
                return pa.schema(scan)
        assert db is not None
        return pa.schema(db._schema_of(self._message, self._options["signals"]))

    def _projected_schema(self, columns: Columns) -> pa.Schema:
        return self._schema if columns is None else _projected(self._schema.empty_table(), columns).schema

    def _needed(self, columns: Columns, filter: pc.Expression | None) -> set[str] | None:
        """The columns that must be decoded; `None` for all."""
        # What an expression needs is not known here.
        if self._message is None or columns is None or isinstance(columns, Mapping):
            return None
        names = set(columns)
        if filter is not None:
            text = str(filter)
            names |= {name for name in self._schema.names if name in text}
        return names

    def _batches(self, wanted: Bounds, needed: set[str] | None, batch_size: int) -> Iterator[pa.RecordBatch]:
        options: Options = {**self._options}
        options["start"], options["end"] = wanted.narrow(options["start"], options["end"])
        if self._message is not None:
            yield from self._decoded(options, needed)
            return
        signals = wanted.signals
        if signals is not None and options["db"] is not None and not options["signals"]:
            known = options["db"]._signal_names()
            chosen = sorted(signals & known)
            if chosen:
                options["signals"] = [_exactly(signal) for signal in chosen]
        with Scan({**options, "files": self._files}, batch_size) as scan:
            for table in scan:
                yield from pa.table(table).cast(self._schema).to_batches()

    def _decoded(self, options: Options, needed: set[str] | None) -> Iterator[pa.RecordBatch]:
        db, message = options["db"], self._message
        assert isinstance(db, Database) and message is not None
        chosen = options["signals"] or [f"{_exactly(message)}.*"]
        if needed is not None:
            of_columns = [name.removesuffix(".text").removeprefix(f"{message}.") for name in needed if name not in NOT_SIGNALS]
            # For `time` alone every frame of the message counts.
            if of_columns:
                chosen = [f"{_exactly(message)}.{_exactly(name)}" for name in of_columns]
        for file in self._files:
            reading = _native.Reading({**options, "db": None, "signals": [], "files": [file]})
            (tables, _), _ = reading.decode(db, chosen, False)
            for name, table in tables:
                if name == message:
                    yield from _with_columns(pa.table(table), self._schema).to_batches()


def _remade(files: list[TraceFile], options: Options, message: str | None, filter: pc.Expression | None) -> Dataset:
    dataset = Dataset(files, options, message)
    return dataset if filter is None else dataset.filter(filter)


def _exactly(name: str) -> str:
    """A pattern that only this name meets."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


def _with_columns(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """The table with all columns; those that were not decoded are empty."""
    columns = [
        table.column(field.name).cast(field.type) if field.name in table.column_names else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.Table.from_arrays(columns, schema=schema)


def _projected(table: pa.Table, columns: Columns) -> pa.Table:
    if isinstance(columns, Mapping):
        return pyarrow.dataset.InMemoryDataset(table).to_table(columns=dict(columns))
    return table.select(list(columns or ()))
