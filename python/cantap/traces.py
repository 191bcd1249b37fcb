"""Trace files."""

from __future__ import annotations

import datetime
import itertools
import numbers
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import IO, TYPE_CHECKING, Any, SupportsIndex, TypeAlias

from . import _native
from ._arguments import channels, identifiers, rates, words
from ._sources import files, is_file
from ._native import CantapWarning, Database, Report, Scan, Table

if TYPE_CHECKING:
    import numpy as np

    from matplotlib.axes import Axes

    from ._native import Options
    from ._dataset import Dataset

Path: TypeAlias = "str | os.PathLike[str]"
Source: TypeAlias = "Path | IO[bytes] | Iterable[Path | IO[bytes]]"
"""Files of one trace: a path, a pattern such as `drives/*.mf4`, a folder, a URL of fsspec such as `s3://bucket/a.blf`, an open file, or
several of these."""
Channels: TypeAlias = "str | SupportsIndex | Iterable[str | SupportsIndex]"
Rates: TypeAlias = "str | SupportsIndex | Sequence[str] | Mapping[Any, str | SupportsIndex]"
"""In bit/s, or `500k`: for all channels, or for each of its own, `2:250k` or in a mapping."""
Databases: TypeAlias = "Path | Database | Iterable[Path] | Mapping[Any, Path]"
Time: TypeAlias = "float | str | datetime.timedelta | datetime.date | np.datetime64 | np.timedelta64 | np.floating[Any] | np.integer[Any]"
Seconds: TypeAlias = "float | str | datetime.timedelta | np.timedelta64"
"""Seconds, `400ms`, or a `timedelta`."""
Words: TypeAlias = "str | Iterable[str]"
Identifiers: TypeAlias = "str | SupportsIndex | Iterable[str | SupportsIndex]"

BATCH_ROWS = 65_536


def load_database(
    files: Path | Iterable[Path] | Mapping[Any, Path], *, j1939: bool = False
) -> Database:
    """Reads signal databases: DBC, KCD, SYM, ARXML, or cantap's own .toml.

    Several files are combined; if two have the same message, the later one is used. A mapping gives each channel its own
    database; channels are what the trace calls them. With `j1939` all 29-bit messages are treated as J1939 parameter groups.

    What is wrong with a usable file is in `Database.warnings`, and causes a `CantapWarning`.
    """
    database = Database(_pairs(files), j1939)
    for text in database.warnings:
        warnings.warn(text, CantapWarning, stacklevel=2)
    return database


def _pairs(files: Any) -> list[tuple[int | str | None, Path]]:
    if isinstance(files, Mapping):
        return [(channel, _database_file(path)) for channel, path in files.items()]
    # An open file is not the names that its lines are.
    if isinstance(files, (str, os.PathLike)) or hasattr(files, "read") or not isinstance(files, Iterable):
        return [(None, _database_file(files))]
    return [(None, _database_file(path)) for path in files]


def _database_file(path: Any) -> Path:
    if isinstance(path, (str, os.PathLike)):
        return path
    kind = type(path)
    text = f"a database is the name of a file, several of them, or a mapping from channels to names, not {kind.__name__}"
    if isinstance(path, Database):
        text = "a loaded database is given alone; load those of several files or channels together: load_database([…]) or load_database({1: …})"
    elif kind.__module__.partition(".")[0] in ("cantools", "canmatrix"):
        text += f" of {kind.__module__.partition('.')[0]}; give the file that it was loaded from, or one that it is written to"
    raise TypeError(text)


def scan(
    path: Source,
    *,
    db: Databases | None = None,
    signals: Words = (),
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
    batch_rows: int = BATCH_ROWS,
) -> Scan:
    """Reads a trace in batches; memory does not grow with the file.

    `path`: a file, a pattern such as `drives/*.mf4`, a folder, a URL of fsspec such as `s3://bucket/a.blf`, a file that was opened with
    `"rb"`, or several of these. Several files are one trace, in the order of a list or of the names. MF4 needs its whole file: from other than a
    path it is held in memory, up to 1 GiB.

    The result is an iterator of tables, and a stream for anything that takes Arrow: `pyarrow.RecordBatchReader.from_stream(scan)`,
    `duckdb.sql("select … from scan")`.

    Without `db` there is a row for each record: frames, bus errors, losses. With it there is a row for each value of each frame in
    the database, and for each event other than a frame.

    `signals`: only these, such as `Speed` or `Engine.Speed`, with the wildcards `*`, `?` and `[a-z]`.
    `filter`: only these frames, in candump's syntax, such as `123` or `can0,120:7F0`; if several are given, any may match.
    `start`, `end`: seconds from the first record or since 1970, `"10m"`, a date, a `timedelta`, a time of NumPy or pandas; the end is
    exclusive. What has no time zone is UTC if it is a text, a date or NumPy's; a `datetime` must name its own.
    `format`: if neither content nor name show it. `zone`: for dates in files that do not name one, such as `Europe/Berlin`.
    `strict`: anything wrong in the file raises `FormatError` instead of causing a `CantapWarning`.

    What was read, and what could not be read, is in `Scan.report`.
    """
    return Scan(_options(path, db, signals, filter, channel, start, end, format, zone, strict), batch_rows)


def read(
    path: Source,
    *,
    db: Databases | None = None,
    signals: Words = (),
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> Table:
    """Reads a trace as one table; the arguments are those of `scan`."""
    options = _options(path, db, signals, filter, channel, start, end, format, zone, strict)
    return Scan(options, BATCH_ROWS).read_all()


class Messages(Mapping[str, Table]):
    """A decoded trace: for each message's name, a table with the columns `time`, `channel`, `id` and one for each signal.

    A signal with texts has two: `Gear` and `Gear.text`. If a frame does not have a signal, there is no value. A signal whose name is
    taken, such as one called `time`, is a column with the message's name in front: `Engine.time`.
    """

    def __init__(self, tables: dict[str, Table], events: Table, report: Report | None) -> None:
        self._tables = tables
        self.events = events
        """Events other than frames: losses, bus errors, states. They explain gaps in a series."""
        self.report = report
        """What was read, and what could not be read; `None` if there was no file."""

    def __getitem__(self, message: str) -> Table:
        try:
            return self._tables[message]
        except KeyError:
            raise KeyError(f"no frame of a message '{message}' was decoded; there are {', '.join(self._tables) or 'none'}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._tables)

    def __len__(self) -> int:
        return len(self._tables)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # While a copy is made there are no tables yet.
            if not name.startswith("_") and name in self._tables:
                raise AttributeError(f"a message is taken by its name: messages['{name}']")
            raise AttributeError(f"'Messages' object has no attribute '{name}'")

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._tables)

    def plot(self, *signals: str, ax: Axes | None = None, **options: Any) -> Axes:
        """Plots signals over time with Matplotlib, as steps: `"Engine.Speed"`, or `"Speed"` if only one message has it."""
        if not signals:
            raise ValueError("name the signals to plot, such as 'Engine.Speed'")
        for signal in signals:
            message, name = self._find(signal)
            ax = self._tables[message].plot(name, ax=ax, **options)
        assert ax is not None
        return ax

    def _find(self, signal: str) -> tuple[str, str]:
        found = [(message, name) for message, table in self._tables.items() for name in table.column_names if signal in (name, f"{message}.{name}")]
        if len(found) != 1:
            several = " and ".join(f"{message}.{name}" for message, name in found)
            raise ValueError(f"there are {several}; choose one" if found else f"there is no signal '{signal}' in {', '.join(self._tables)}")
        return found[0]

    def __repr__(self) -> str:
        return f"<cantap.Messages: {', '.join(self._tables)}>"

    def _repr_html_(self) -> str:
        from ._columns import messages_to_html

        return messages_to_html(self)


def decode(
    source: Any,
    db: Databases,
    *,
    signals: Words = (),
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> Messages:
    """Decodes a trace into a table for each message, with a column for each signal.

    `source` is what `scan` reads, or a table of records, such as a device's batches: from this package, or anything else that exports
    Arrow; or messages of python-can, in a list or as a reader.
    The other arguments are those of `scan`; for a table, only `signals` is allowed.

    If a file's frames are all unknown to the databases, there is a `CantapWarning`. Of two messages with one name, the later has its
    identifier behind it, as in `Engine-1A0`.
    """
    source = _unpacked(source)
    if _is_file(source):
        if db is None:
            raise ValueError("a database decodes; give one with db=")
        chosen = words(signals, "signals")
        options = _options(source, None, (), filter, channel, start, end, format, zone, strict)
        # It is read while the database is loaded.
        reading = _native.Reading(options)
        (tables, events), report = reading.decode(_database(db), chosen)
        return Messages(dict(tables), events, report)
    if filter or channel != () or (start, end, format, zone) != (None,) * 4 or strict:
        raise ValueError("of a table only signals can be chosen; choose its rows before")
    tables, events = _native.decode_table(_table(source), _database(db), words(signals, "signals"))
    return Messages(dict(tables), events, None)


def search(
    path: Source,
    condition: str | None = None,
    *,
    id: Identifiers = (),
    data: Words = (),
    max_count: int | None = None,
    db: Databases | None = None,
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> Table:
    """The records that meet every given criterion, with `place`, their index among those that were read, from 0.

    `condition`: as for `cantap search`, such as `"Speed > 80 and Gear == Drive"`. `id`: `"123"`, `"18FEF1??"`, `"100-1FF"`, or a number,
    `0x123`, which has 29 bits if it is above 0x7FF; any of several may match. `data`: bytes from the first on, `"11 ?? 3?"`, with `*` for any number; any of several may match.
    """
    options = _options(path, db, (), filter, channel, start, end, format, zone, strict)
    return _native.search(options, condition, identifiers(id, "id"), words(data, "data"), max_count)


def stats(
    path: Source,
    bitrate: Rates | None = None,
    *,
    data_bitrate: Rates | None = None,
    window: Seconds = 1.0,
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> dict[str, Any]:
    """Statistics of a trace, as from `cantap stats --json`: load, rates, periods and jitter by identifier, losses, errors.

    `bitrate`: in bit/s or as `500k`, for all channels or by channel (`{2: "250k"}`, `"2:250k"`); without it there is no load. `data_bitrate`: for CAN FD's data phases.
    `window`: length of the windows searched for peaks, in seconds or as `100ms`.
    """
    options = _options(path, None, (), filter, channel, start, end, format, zone, strict)
    return _native.stats(options, rates(bitrate, "bitrate"), rates(data_bitrate, "data_bitrate"), window)


def write(
    table: Any,
    path: Path,
    *,
    db: Databases | None = None,
    signals: Words = (),
    format: str | None = None,
    zone: str | None = None,
) -> dict[str, int]:
    """Writes a table of records as a trace, in the format of the file's name or in `format`; `.parquet` works, too. With `db` it writes the
    frames' signals, or those that `signals` chooses, as an MCAP file for Foxglove, whose name ends in `.mcap`.

    `table` comes from this package, also as a `scan`, which is never in memory as a whole, or anything else that exports Arrow, such as pandas and
    Polars; or it is a mapping of columns, or messages of python-can. Of the columns of `read` only
    `time`, `id` and `data` must be there; docs/python.md says what stands for the others, and which types are taken.

    An older file with that name stays unchanged until the new one is complete. Returns what the file does not carry, by kind: also
    columns that no trace has. Anything at all also causes a `CantapWarning`.
    """
    if db is None and words(signals, "signals"):
        raise ValueError("signals are chosen out of a database; give one with db=")
    decoder = None if db is None else (_database(db), words(signals, "signals"))
    left_out = _native.write(_table(table), path, format, zone, decoder)
    for what, count in left_out.items():
        warnings.warn(f"{path} does not carry {what} ({count})", CantapWarning, stacklevel=2)
    return left_out


def encode(signals: Mapping[str, Any], db: Databases) -> Table:
    """Makes frames out of signals: the inverse of `decode`. Returns a table of records, in the order of their times, for `write`.

    `signals`: for each message's name a table, as `decode` returns, or a mapping of columns: `time`, and one for each signal, with
    numbers or the texts of its table. `channel` is 1 if there is no such column. Where a signal has no value, the frame has the
    database's start value, or 0. Bits of a frame that no signal describes are 0.

    A value that the database's limits forbid is encoded all the same, if it fits, and causes a `CantapWarning`.
    """
    tables = [(message, _columns_table(table)) for message, table in signals.items()]
    return _native.encode_tables(tables, _database(db))


def dataset(
    path: Source,
    *,
    db: Databases | None = None,
    message: str | None = None,
    signals: Words = (),
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> Dataset:
    """Traces as a dataset of pyarrow, which reads the files when it is queried: by DuckDB, by `pyarrow.dataset`, and by Polars with
    `.to_polars()`, a LazyFrame. The arguments are those of `scan`.

    With `message`, it has a column for each of that message's signals. A filter's bounds on `time`, the signals that it names, and
    the columns that are wanted, decide what is decoded.
    """
    from ._dataset import Dataset

    if message is not None and db is None:
        raise ValueError("a message is decoded with a database; give one with db=")
    options = _options(path, db, signals, filter, channel, start, end, format, zone, strict)
    return Dataset(options["files"], options, message)


def _is_file(source: Any) -> bool:
    """Whether it is read, rather than a table."""
    if hasattr(source, "__arrow_c_stream__"):
        return False
    return is_file(source[0] if isinstance(source, (list, tuple)) and source else source)


def _unpacked(source: Any) -> Any:
    """An iterator of paths, such as `Path.glob` returns, as a list; anything else as it is."""
    if not isinstance(source, Iterator) or is_file(source) or hasattr(source, "__arrow_c_stream__"):
        return source
    first = list(itertools.islice(source, 1))
    return [*first, *source] if first and is_file(first[0]) else itertools.chain(first, source)


def _table(source: Any) -> Any:
    """A table of records: of messages of python-can, too."""
    if isinstance(source, Messages):
        raise TypeError("these are decoded signals: cantap.encode(messages, db) makes frames of them, and each of its tables has to_pandas() and to_polars()")
    source = _columns_table(source)
    is_table = hasattr(source, "__arrow_c_stream__")
    if not is_table and isinstance(source, Iterable) and not isinstance(source, (str, bytes)):
        return _native.table_of_messages(source)
    return source


def _columns_table(table: Any) -> Any:
    """A table, also of a mapping of columns."""
    if isinstance(table, Mapping) and not hasattr(table, "__arrow_c_stream__"):
        try:
            import pyarrow as pa
        except ModuleNotFoundError as error:
            text = "a mapping of columns becomes a table by pyarrow; install it: pip install 'cantap[arrow]'"
            raise ModuleNotFoundError(text, name="pyarrow") from error
        return pa.table(dict(table))
    return _arrow(table)


def _arrow(table: Any) -> Any:
    """The same, from versions of other programs that do not export Arrow themselves yet: pandas before 2.2, Polars before 1.3."""
    if hasattr(table, "__arrow_c_stream__"):
        return table
    if hasattr(table, "to_arrow"):
        return table.to_arrow()
    if type(table).__module__.partition(".")[0] == "pandas" and hasattr(table, "columns"):
        import pyarrow as pa

        return pa.Table.from_pandas(table)
    return table


def _options(
    path: Source,
    db: Databases | None,
    signals: Words,
    filter: Words,
    channel: Channels,
    start: Time | None,
    end: Time | None,
    format: str | None,
    zone: str | None,
    strict: bool,
) -> Options:
    return {
        "files": files(path),
        "db": None if db is None else _database(db),
        "signals": words(signals, "signals"),
        "filters": words(filter, "filter"),
        "channels": channels(channel),
        "start": _time(start),
        "end": _time(end),
        "format": format,
        "zone": zone,
        "strict": bool(strict),
    }


def _database(db: Databases) -> Database:
    return db if isinstance(db, Database) else load_database(db)


def _time(time: Time | None) -> str | None:
    """A time in the command's syntax."""
    if time is None or isinstance(time, str):
        return time
    kind = getattr(getattr(time, "dtype", None), "kind", None)
    if kind in ("M", "m"):
        numpy_time: Any = time
        ns = int(numpy_time.astype(f"{kind}8[ns]").astype("int64"))
        # This is NumPy's NaT, as far as it can be told without importing it.
        if ns == -(2**63):
            raise ValueError(f"{time} is not a time")
        return _date_text(_EPOCH, ns) if kind == "M" else f"{'-' if ns < 0 else ''}{abs(ns) // 10**9}.{abs(ns) % 10**9:09}s"
    if isinstance(time, datetime.timedelta):
        # The letter keeps a long one from being mistaken for a date.
        return f"{time.total_seconds():.9f}s"
    if isinstance(time, datetime.datetime):
        if time.tzinfo is None:
            raise ValueError(
                f"{time} has no time zone; give it one, as with replace(tzinfo=datetime.timezone.utc)"
            )
        # pandas' have nanoseconds, too.
        return _date_text(time, getattr(time, "nanosecond", 0))
    if isinstance(time, datetime.date):
        return time.isoformat()
    if isinstance(time, numbers.Real):
        return f"{float(time):.9f}"
    raise TypeError(f"a time is a number, a text, a timedelta, a date or a datetime, not {type(time).__name__}")


_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)


def _date_text(time: datetime.datetime, more_ns: int) -> str:
    """A date in UTC, so many nanoseconds later. As a number it would count from the trace's first record if it is an early one."""
    seconds, ns = divmod(more_ns, 10**9)
    utc = time.astimezone(datetime.timezone.utc) + datetime.timedelta(seconds=seconds)
    return f"{utc:%Y-%m-%dT%H:%M:%S}.{utc.microsecond * 1000 + ns:09}"


__all__ = [
    "Database",
    "Messages",
    "Report",
    "Scan",
    "Table",
    "dataset",
    "decode",
    "encode",
    "load_database",
    "read",
    "scan",
    "search",
    "stats",
    "write",
]
