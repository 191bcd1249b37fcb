"""Trace files."""

from __future__ import annotations

import datetime
import os
import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from . import _native
from ._native import CantapWarning, Database, Report, Scan, Table

if TYPE_CHECKING:
    from ._native import Options

Path: TypeAlias = "str | os.PathLike[str]"
Databases: TypeAlias = "Path | Database | Iterable[Path] | Mapping[int, Path]"
Time: TypeAlias = "float | str | datetime.timedelta | datetime.datetime"
Words: TypeAlias = "str | Iterable[str]"

BATCH_ROWS = 65_536


def load_database(
    files: Path | Iterable[Path] | Mapping[int, Path], *, j1939: bool = False
) -> Database:
    """Reads signal databases: DBC, KCD, SYM, ARXML, or cantap's own .toml.

    Several are one; of a message that two have, the later counts. A mapping gives each channel (from 1) its own. With `j1939`
    all 29-bit messages are taken for J1939 parameter groups.

    What is wrong with a file and can be lived with is in `Database.warnings`, and is a `CantapWarning`.
    """
    database = Database(_pairs(files), j1939)
    for text in database.warnings:
        warnings.warn(text, CantapWarning, stacklevel=2)
    return database


def _pairs(files: Any) -> list[tuple[int | None, Path]]:
    if isinstance(files, (str, os.PathLike)):
        return [(None, files)]
    if isinstance(files, Mapping):
        return [(channel, path) for channel, path in files.items()]
    return [(None, path) for path in files]


def scan(
    path: Path,
    *,
    db: Databases | None = None,
    signals: Words = (),
    filter: Words = (),
    channel: int | Iterable[int] = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
    batch_rows: int = BATCH_ROWS,
) -> Scan:
    """Reads a trace in batches; memory does not grow with the file.

    The result is an iterator of tables, and a stream for whatever takes Arrow: `pyarrow.RecordBatchReader.from_stream(scan)`,
    `duckdb.sql("select … from scan")`.

    Without `db` there is a row for each record: frames, bus errors, losses. With it there is a row for each value of each frame that
    the database has, and for what happened beside frames.

    `signals`: only these, `Speed`, `Engine.Speed`, with `*`, `?` and `[a-z]`.
    `filter`: only these frames, in candump's syntax, such as `123` or `can0,120:7F0`; any of several.
    `start`, `end`: seconds from the first record or since 1970, `"10m"`, a date, a `timedelta`; the end is exclusive.
    `format`: where neither content nor name tell. `zone`: of dates in files that name none, such as `Europe/Berlin`.
    `strict`: what is wrong in the file is a `FormatError` instead of a `CantapWarning`.

    What was read, and what could not be, is in `Scan.report`.
    """
    return Scan(_options(path, db, signals, filter, channel, start, end, format, zone, strict), batch_rows)


def read(
    path: Path,
    *,
    db: Databases | None = None,
    signals: Words = (),
    filter: Words = (),
    channel: int | Iterable[int] = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> Table:
    """Reads a trace as one table; everything is as with `scan`."""
    options = _options(path, db, signals, filter, channel, start, end, format, zone, strict)
    return Scan(options, BATCH_ROWS).read_all()


def _options(
    path: Path,
    db: Databases | None,
    signals: Words,
    filter: Words,
    channel: int | Iterable[int],
    start: Time | None,
    end: Time | None,
    format: str | None,
    zone: str | None,
    strict: bool,
) -> Options:
    return {
        "path": path,
        "db": db if db is None or isinstance(db, Database) else load_database(db),
        "signals": _words(signals),
        "filters": _words(filter),
        "channels": _channels(channel),
        "start": _time(start),
        "end": _time(end),
        "format": format,
        "zone": zone,
        "strict": strict,
    }


def _channels(channel: int | Iterable[int]) -> list[int]:
    channels = [channel] if isinstance(channel, int) else list(channel)
    for number in channels:
        if not 1 <= number <= 255:
            raise ValueError(f"there is no channel {number}; they count from 1 to 255")
    return channels


def _words(words: Words) -> list[str]:
    return [words] if isinstance(words, str) else list(words)


def _time(time: Time | None) -> str | None:
    """A time as the command takes it."""
    if time is None or isinstance(time, str):
        return time
    if isinstance(time, datetime.timedelta):
        # The letter keeps a long one from being taken for a date.
        return f"{time.total_seconds():.9f}s"
    if isinstance(time, datetime.datetime):
        if time.tzinfo is None:
            raise ValueError(
                f"{time} has no time zone; give it one, as with replace(tzinfo=datetime.timezone.utc)"
            )
        since = time - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
        whole = since // datetime.timedelta(seconds=1)
        return f"{whole}.{(since - datetime.timedelta(seconds=whole)).microseconds:06}"
    if isinstance(time, (int, float)):
        return f"{time:.9f}"
    raise TypeError(f"a time is a number, a text, a timedelta or a datetime, not {type(time).__name__}")


__all__ = ["Database", "Report", "Scan", "Table", "load_database", "read", "scan"]
