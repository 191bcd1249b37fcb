"""A process that decodes one trace after the other, so that a trace that hangs or kills it affects nothing else.

It reads requests from standard input, a line of JSON each, and answers with a line of JSON. Rows go into a file, from which they
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
from collections.abc import Iterator
from typing import Any, TypedDict

import cantap
import pyarrow as pa

from . import columns
from .ledger import CUT, DAMAGED, EMPTY, FAILED, READ, REFUSED, Entry


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
    #: Where rows go.
    rows: str


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


def _write(writer: Any, scan: cantap.Scan, part: str, request: Request) -> int:
    """Writes all rows, and returns their number."""
    rows = 0
    for batch in _batches(scan):
        writer.write(columns.rows_of(batch, part, request["vehicle"], request["trace"], rows))
        rows += batch.num_rows
    return rows


def decode(request: Request) -> Entry:
    """Decodes a trace into the file of rows; without rows if the state is refused or failed."""
    entry = Entry(request["trace"], request["vehicle"], request["bytes"], databases=request["database_names"])
    path, zone = request["path"], request["zone"]
    try:
        database = _databases(request)
        with pa.OSFile(request["rows"], "wb") as file, pa.ipc.new_stream(file, columns.STREAM_SCHEMA) as writer:
            scan = cantap.scan(path, zone=zone)
            records = _write(writer, scan, "frames", request)
            report = scan.report
            if database is not None:
                scan = cantap.scan(path, zone=zone, db=database, signals=request["signals"])
                entry.signal_rows = _write(writer, scan, "signals", request)
                entry.decoded = scan.report.decoded
                if (scan.report.records_read, scan.report.issues) != (report.records_read, report.issues):
                    raise OSError("it changed while it was read")
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
        entry.left_out, entry.notes = report.left_out, report.notes
        entry.problem = entry.faults[0] if entry.faults else None
        entry.state = _state(report)
        if entry.state == EMPTY:
            entry.problem = "it has no record"
        return entry
    entry.signal_rows = entry.decoded = 0
    return entry


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


def _requests(scratch: str) -> Iterator[Request]:
    """The requests, until the requesting process is gone: then this ends immediately, whatever it is doing."""
    waiting: queue.Queue[Request] = queue.Queue()

    def listen() -> None:
        for line in sys.stdin:
            waiting.put(json.loads(line))
        shutil.rmtree(scratch, ignore_errors=True)
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        yield waiting.get()


def main() -> None:
    """Answers requests. The argument is the folder of the requesting process, which is removed at the end."""
    # Faults in a trace are in the ledger.
    warnings.simplefilter("ignore", cantap.CantapWarning)
    for request in _requests(sys.argv[1]):
        print(json.dumps(decode(request).to_dict()), flush=True)


if __name__ == "__main__":
    main()
