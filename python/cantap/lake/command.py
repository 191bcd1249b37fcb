"""The command `cantap-lake`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress

import pyarrow.compute as pc

from .._native import CantapError, seconds
from . import influx
from .compaction import FILE_BYTES, compact, vacuum
from .ingest import ingest
from .ledger import FAILED, REFUSED
from .store import Store, StoreError
from .transactions import Busy
from .views import views
from .writing import TABLES


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cantap-lake", description="Many traces as tables of Parquet, decoded once each.")
    commands = parser.add_subparsers(dest="command", required=True)
    add = commands.add_parser("add", help="read traces into a lake; those that are in it already are not read again")
    add.add_argument("lake", help="the lake's folder, which is made if it is not there")
    add.add_argument("source", nargs="+", help="a trace, a pattern, a folder with everything below it, a URL such as s3://bucket/*.blf")
    add.add_argument("--db", metavar="[CHANNEL=]FILE", action="append", default=[], help="a database; can be repeated")
    add.add_argument("--j1939", action="store_true", help="29-bit messages of the databases are J1939 parameter groups")
    add.add_argument("--signal", metavar="PATTERN", action="append", default=[], help="only these signals; can be repeated")
    add.add_argument("--vehicle", metavar="NAME", help="whose traces they are [default: the folder that they are in]")
    add.add_argument("--zone", help="of dates in traces that name none, such as Europe/Berlin [default: UTC]")
    add.add_argument("--workers", metavar="N", type=_count, help="how many traces at a time [default: as many as there are processors]")
    add.add_argument("--timeout", metavar="TIME", type=_seconds, default=3600.0, help="longest time for one trace, in seconds or as 2h [default: 1h]")
    add.add_argument("--split", metavar="SIZE", type=_size_or_none, help="length of the parts in which all workers read a large trace; 0: never")
    add.add_argument("--retry", action="store_true", help="also those that were refused before")
    ledger = commands.add_parser("ledger", help="what became of each trace, a line of JSON each")
    ledger.add_argument("lake")
    lines = commands.add_parser("influx", help="print the signals in InfluxDB's line protocol, a line for each frame")
    lines.add_argument("lake")
    lines.add_argument("--vehicle", metavar="NAME", help="only this vehicle's")
    lines.add_argument("--message", metavar="NAME", action="append", default=[], help="only this message; can be repeated")
    delta = commands.add_parser("delta", help="make the tables Delta tables, too, of the files that they have now")
    delta.add_argument("lake")
    sql = commands.add_parser("views", help="print SQL that makes views of the tables and the ledger in a database of DuckDB")
    sql.add_argument("lake")
    sql.add_argument("--wide", action="store_true", help="also a view for each message, with a column for each signal; reads the names of all signals")
    joining = commands.add_parser("compact", help="join small files of the same vehicle, day and channel; rows and ledger stay the same")
    joining.add_argument("lake")
    default = f"{FILE_BYTES >> 20}M"
    joining.add_argument("--file-size", metavar="SIZE", type=_size, default=FILE_BYTES, help=f"join up to this length, such as 64M [default: {default}]")
    removing = commands.add_parser("vacuum", help="remove files that are not used any more: those that were joined, and what interrupted runs left")
    removing.add_argument("lake")
    removing.add_argument("--older-than", metavar="HOURS", type=_hours, required=True, help="not used for so long; longer than any query takes")
    check = commands.add_parser("check", help="count the rows of all files, and look for what an interrupted run left")
    check.add_argument("lake")
    check.add_argument("--remove", action="store_true", help="remove what an interrupted run left")
    check.add_argument("--forget", action="store_true", help="remove the entries of traces whose files are not as they say: they are read again")
    return parser


def _count(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 1024):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 1 to 1024")
    return int(text)


def _seconds(text: str) -> float:
    try:
        time = seconds(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if not 0 < time < 1e9:
        raise argparse.ArgumentTypeError(f"'{text}' is not a time; give more than 0")
    return time


def _hours(text: str) -> float:
    try:
        hours = float(text)
    except ValueError:
        hours = -1.0
    if not 0 <= hours < 1e6:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of hours; give 0 or more")
    return hours


def _size(text: str) -> int:
    units = {"K": 10, "M": 20, "G": 30}
    digits, shift = (text[:-1], units[text[-1]]) if text[-1:] in units else (text, 0)
    if not (digits.isascii() and digits.isdecimal() and 0 < int(digits) << shift < 1 << 40):
        raise argparse.ArgumentTypeError(f"'{text}' is not a length; give bytes, or K, M or G of them, such as 64M")
    return int(digits) << shift


def _size_or_none(text: str) -> int:
    return 0 if text == "0" else _size(text)


def _databases(texts: Sequence[str]) -> dict[int, str] | list[str] | None:
    pairs = [text.partition("=") for text in texts]
    if not any(equals and channel.isdecimal() for channel, equals, _ in pairs):
        return list(texts) or None
    if not all(equals and channel.isdecimal() for channel, equals, _ in pairs):
        raise StoreError("either each --db names its channel, as in --db 1=car.dbc, or none does")
    return {int(channel): path for channel, _, path in pairs}


def _add(arguments: argparse.Namespace) -> int:
    summary = ingest(
        arguments.source,
        arguments.lake,
        db=_databases(arguments.db),
        j1939=arguments.j1939,
        signals=arguments.signal,
        vehicle=arguments.vehicle,
        zone=arguments.zone,
        workers=arguments.workers,
        timeout=arguments.timeout,
        retry=arguments.retry,
        part_bytes=arguments.split,
    )
    for trace, problem in sorted(summary.problems.items()):
        print(f"{_clean(trace)}: {_clean(problem)}", file=sys.stderr)
    words = ", ".join(f"{count} {state}" for state, count in sorted(summary.states.items()))
    print(f"{summary.states.total()} traces: {words or 'none'}; {summary.records} records added")
    return 1 if summary.states[FAILED] + summary.states[REFUSED] else 0


def _check(arguments: argparse.Namespace) -> int:
    store = Store(arguments.lake)
    problems = list(store.problems())
    for problem in problems:
        print(_clean(problem), file=sys.stderr)
    if arguments.forget:
        for trace in store.forget():
            print(f"{_clean(trace)}: forgotten; add it again")
    stray = []
    # What is being written looks like what was left.
    with nullcontext() if arguments.remove else suppress(Busy, PermissionError), store.transactions.alone():
        stray = store.stray()
        for path in stray if arguments.remove else ():
            path.unlink()
    left = "removed" if arguments.remove else "found; --remove removes them"
    print(f"{sum(1 for _ in store.entries())} traces, {len(problems)} problems" + (f", {len(stray)} files of an interrupted run {left}" if stray else ""))
    return 1 if problems else 0


def _compact(arguments: argparse.Namespace) -> int:
    done = compact(arguments.lake, file_bytes=arguments.file_size)
    for problem in done.problems:
        print(_clean(problem), file=sys.stderr)
    print(f"{done.files} files joined into {done.joined}, {done.bytes / (1 << 20):.1f} MiB")
    return 1 if done.problems else 0


def _influx(arguments: argparse.Namespace) -> int:
    wanted = pc.scalar(True)
    if arguments.vehicle is not None:
        wanted &= pc.field("vehicle") == arguments.vehicle
    if arguments.message:
        # Losses and errors explain gaps.
        wanted &= pc.field("message").isin(arguments.message) | (pc.field("event") != "value")
    left = influx.Left()
    for line in influx.lines(Store(arguments.lake).dataset("signals").to_batches(filter=wanted), left):
        print(line)
    if left.values:
        print(f"left out: {left.values} values that are not available or no numbers, and {left.frames} frames without any other", file=sys.stderr)
    return 0


def _clean(text: str) -> str:
    """Names and texts come from files of others."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; the exit code is 1 if a trace could not be read, or the lake is not as its ledger says."""
    chosen = _parser().parse_args(arguments)
    try:
        if chosen.command == "add":
            return _add(chosen)
        if chosen.command == "check":
            return _check(chosen)
        if chosen.command == "influx":
            return _influx(chosen)
        if chosen.command == "compact":
            return _compact(chosen)
        if chosen.command == "vacuum":
            print(f"{len(vacuum(chosen.lake, retain_hours=chosen.older_than))} files removed")
            return 0
        if chosen.command == "views":
            print(views(Store(chosen.lake), wide=chosen.wide), end="")
            return 0
        if chosen.command == "delta":
            for table in TABLES:
                print(f"{table}: version {Store(chosen.lake).write_delta(table)}")
            return 0
        for entry in Store(chosen.lake).entries():
            print(json.dumps(entry, sort_keys=True))
        return 0
    except BrokenPipeError:
        # Whoever reads has enough.
        sys.stderr.close()
        return 1
    except (StoreError, Busy, OSError, ValueError, ModuleNotFoundError, CantapError) as error:
        print(f"error: {_clean(str(error))}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
