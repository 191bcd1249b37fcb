"""A process that decodes one trace after the other, so that a trace that hangs or kills it affects nothing else.

It reads requests from standard input, a line of JSON each, and answers with a line of JSON. Rows go into a file, or into several in a folder, which
are passed on only when the whole trace is done. It ends together with the process that started it.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypedDict

import cantap
import pyarrow as pa
from cantap import _native, traces

from . import columns
from .ledger import CUT, DAMAGED, EMPTY, FAILED, READ, REFUSED, UNDECODED, Entry
from .splitting import Pieces
from .writing import Writing


class Part(TypedDict):
    """One of several parts of a trace."""

    format: str | None
    #: As `splitting` has them; `None`: the part is what is between two times.
    pieces: list[Any] | None
    #: From a time to before another, in nanoseconds since 1970; `None`: from the beginning, to the end.
    window: tuple[int | None, int | None]
    #: Where the trace's index is.
    indexes: str | None
    #: How many rows of frames and signals the parts before it have; `None`: rows are only counted.
    first_rows: tuple[int, int] | None


class Request(TypedDict):
    """What to decode."""

    #: The trace, in this machine's file system.
    path: str
    trace: str
    vehicle: str
    bytes: int
    #: A database's channel (`None` for all), and its path.
    databases: list[tuple[int | None, str]]
    #: Their names in the ledger.
    database_names: list[str]
    j1939: bool
    #: Only these signals; all if empty.
    signals: list[str]
    zone: str | None
    #: Where rows go: a file of Arrow's for all, or a folder for files of Parquet, with the name of each.
    rows: str
    stem: str | None
    #: All of it, if `None`.
    part: Part | None
    #: Nothing is decoded: only the times are found that divide the trace into parts of so many bytes; their index goes into this folder.
    divide: tuple[int, str] | None


#: Databases that stay loaded: a task's traces are mostly of one vehicle.
_loaded: dict[tuple[Any, ...], cantap.Database] = {}
_LOADED_AT_ONCE = 16


def _databases(request: Request) -> cantap.Database | None:
    if not request["databases"]:
        return None
    key = (request["j1939"], *[tuple(pair) for pair in request["databases"]])
    if key not in _loaded:
        while len(_loaded) >= _LOADED_AT_ONCE:
            del _loaded[next(iter(_loaded))]
        _loaded[key] = cantap.Database([(channel, path) for channel, path in request["databases"]], request["j1939"])
    return _loaded[key]


def _batches(scan: cantap.Scan) -> Iterator[pa.RecordBatch]:
    for table in scan:
        yield from pa.table(table).combine_chunks().to_batches()


class _Stream:
    """Rows as one stream: for those who distribute them."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._file = pa.OSFile(request["rows"], "wb")
        self._writer = pa.ipc.new_stream(self._file, columns.STREAM_SCHEMA, options=pa.ipc.IpcWriteOptions(compression="zstd"))

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.close()
        self._file.close()

    def write(self, part: str, batch: pa.RecordBatch, first_row: int) -> None:
        self._writer.write(columns.rows_of(batch, part, self._request["vehicle"], self._request["trace"], first_row))

    def names(self) -> dict[str, dict[str, int]]:
        return {}


class _Counted:
    """Rows that nobody wants yet, and that are not made."""

    def __enter__(self) -> _Counted:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def names(self) -> dict[str, dict[str, int]]:
        return {}


def _rows(request: Request) -> _Stream | Writing | _Counted:
    if request["part"] is not None and request["part"]["first_rows"] is None:
        return _Counted()
    if request["stem"] is None:
        return _Stream(request)
    return Writing(Path(request["rows"]), request["stem"], request["vehicle"], request["trace"])


def _write(rows: _Stream | Writing | _Counted, scan: cantap.Scan, part: str, first_row: int) -> int:
    """Writes all rows, and returns their number."""
    if isinstance(rows, _Counted):
        return scan._count()
    count = 0
    for batch in _batches(scan):
        rows.write(part, batch, first_row + count)
        count += batch.num_rows
    return count


def decode(request: Request) -> tuple[Entry, dict[str, dict[str, int]]]:
    """Decodes a trace; without rows if the state is refused or failed. The files that were written are by table, each with its rows."""
    rows = _rows(request)
    entry = _decode(request, rows)
    return entry, rows.names() if entry.state not in (REFUSED, FAILED) else {}


def _decode(request: Request, rows: _Stream | Writing | _Counted) -> Entry:
    entry = Entry(request["trace"], request["vehicle"], request["bytes"], databases=request["database_names"])
    part = request["part"]
    first_rows = part["first_rows"] or (0, 0) if part else (0, 0)
    try:
        with rows, _source(request) as source, _source(request) as again:
            unusable, decoding = None, None
            if isinstance(rows, _Counted):
                decoding, unusable = _decoding(request, again)
            # How many records there are, this says as well.
            if decoding is None:
                scan = _scan(request, source)
                records, report, read = _write(rows, scan, "frames", first_rows[0]), scan.report, source
                if not isinstance(rows, _Counted):
                    decoding, unusable = _decoding(request, again)
            if decoding is not None:
                entry.signal_rows = _write(rows, decoding, "signals", first_rows[1])
                entry.decoded = decoding.report.decoded
                if isinstance(rows, _Counted):
                    records, report, read = decoding.report.records, decoding.report, again
                elif (decoding.report.records_read, decoding.report.issues) != (report.records_read, report.issues):
                    raise OSError("it changed while it was read")
            if isinstance(read, Pieces) and not read.is_independent():
                raise OSError("its parts depend on each other")
    except cantap.CantapError as error:
        entry.state, entry.problem = REFUSED, _in_words(error, request)
    except OSError as error:
        entry.state, entry.problem = FAILED, _in_words(error, request)
    else:
        entry.format = report.format
        entry.records, entry.frames = records, report.frames
        entry.lost, entry.lost_at_least = report.lost, report.lost_at_least
        entry.bus_errors, entry.issues = report.bus_errors, report.issues
        entry.faults = [_without_folders(fault, request) for fault in report.faults]
        entry.left_out, entry.notes, entry.properties = report.left_out, report.notes, report.properties
        entry.problem = entry.faults[0] if entry.faults else None
        entry.state = _state(report)
        if request["databases"] and report.frames:
            entry.coverage = entry.decoded / report.frames
        if entry.state == EMPTY:
            entry.problem = "it has no record"
        elif entry.coverage == 0:
            # What is wrong with the trace itself comes first: rows are missing.
            entry.problem = "; ".join(filter(None, [entry.problem, unusable or _none_decoded(request)]))
            if entry.state == READ:
                entry.state = UNDECODED
        return entry
    entry.signal_rows = entry.decoded = 0
    return entry


def _scan(request: Request, source: Any, db: cantap.Database | None = None, signals: Sequence[str] = ()) -> cantap.Scan:
    part = request["part"]
    options = traces._options(source, db, signals, (), (), None, None, part["format"] if part else None, request["zone"], False)
    if part:
        options["start"], options["end"] = (None if ns is None else traces._date_text(traces._EPOCH, ns) for ns in part["window"])
        if part["indexes"]:
            options["indexes"] = part["indexes"]
    return cantap.Scan(options, traces.BATCH_ROWS)


def _divided(request: Request) -> dict[str, Any]:
    """The times that divide a trace, and how many records each part has."""
    assert request["divide"] is not None
    part_bytes, indexes = request["divide"]
    options = traces._options(request["path"], None, (), (), (), None, None, None, request["zone"], False)
    try:
        return {"parts": _native.divide(request["path"], {**options, "indexes": indexes}, part_bytes)}
    except (cantap.CantapError, OSError):
        # Whoever reads it says what is wrong.
        return {"parts": None}


@contextmanager
def _source(request: Request) -> Iterator[Any]:
    part = request["part"]
    if part is None or part["pieces"] is None:
        yield request["path"]
        return
    pieces = Pieces(request["path"], part["pieces"], request["path"], part["format"] or "")
    try:
        yield pieces
    finally:
        pieces.close()


def _decoding(request: Request, source: Any) -> tuple[cantap.Scan | None, str | None]:
    """The trace's signals, or the reason why its vehicle's databases have none: that does not affect its frames."""
    try:
        database = _databases(request)
        if database is None:
            return None, None
        return _scan(request, source, db=database, signals=request["signals"]), None
    except cantap.DatabaseError as error:
        return None, f"no signals: {_in_words(error, request)}"


def _none_decoded(request: Request) -> str:
    names = ", ".join(request["database_names"])
    chosen = f" with the signals {', '.join(request['signals'])}" if request["signals"] else ""
    return f"no signals: {names} has a message{chosen} for none of its frames"


def _state(report: cantap.Report) -> str:
    if report.is_whole:
        return READ if report.records_read or report.left_out else EMPTY
    # If compressed data ends too early, so does its content: two places, one cause.
    causes = 2 if report.issues == 2 and "inside the compressed data" in report.faults[-1] else 1
    return CUT if report.is_cut and report.issues == causes else DAMAGED


def _in_words(error: Exception, request: Request) -> str:
    return _without_folders(str(error), request)


def _without_folders(text: str, request: Request) -> str:
    """The ledger names inputs as the user does: this machine's folders are irrelevant, and differ from run to run."""
    text = text.replace(request["path"], request["trace"])
    for (_, path), name in zip(request["databases"], request["database_names"], strict=True):
        text = text.replace(path, name)
    return text


def _requests(scratch: Sequence[str]) -> Iterator[Request]:
    """The requests, until the requesting process is gone: then this ends immediately, whatever it is doing."""
    waiting: queue.Queue[Request] = queue.Queue()

    def listen() -> None:
        for line in sys.stdin:
            waiting.put(json.loads(line))
        for folder in scratch:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        yield waiting.get()


def main() -> None:
    """Answers requests. The arguments are folders of the requesting process, which are removed at the end."""
    # Faults in a trace are in the ledger.
    warnings.simplefilter("ignore", cantap.CantapWarning)
    for request in _requests(sys.argv[1:]):
        if request["divide"] is not None:
            print(json.dumps(_divided(request)), flush=True)
            continue
        entry, files = decode(request)
        print(json.dumps({**entry.to_dict(), "files": files} if files else entry.to_dict()), flush=True)


if __name__ == "__main__":
    main()
