"""What frames mean by the protocols of their bus."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from . import _native
from ._arguments import words
from ._native import Table
from .traces import Channels, Databases, Path, Source, Time, Words, _database, _is_file, _options, _table, _unpacked

if TYPE_CHECKING:
    from ._native import Bus

Protocol: TypeAlias = Literal[
    "isotp", "uds", "kwp2000", "obd", "j1939", "nmea2000", "canopen", "devicenet", "xcp", "ccp", "dronecan", "cyphal"
]
Paths: TypeAlias = "Path | Iterable[Path]"


def conversations(
    source: Source | Any,
    *,
    protocol: Protocol | str | Iterable[Protocol | str] = (),
    fields: Words = (),
    faults: bool = False,
    db: Databases | None = None,
    pair: Words = (),
    eds: Paths = (),
    odx: Paths = (),
    a2l: Paths = (),
    xcp: Words = (),
    ccp: Words = (),
    dsdl: Paths = (),
    subject: Words = (),
    filter: Words = (),
    channel: Channels = (),
    start: Time | None = None,
    end: Time | None = None,
    format: str | None = None,
    zone: str | None = None,
    strict: bool = False,
) -> Table:
    """What the frames of a trace mean, as `cantap conversations` says it: a table with a row for each exchange, transfer or message of a protocol.

    `source`: what `read` takes, or a table of records, such as a device's batch. `filter` to `strict` are those of `read`, for files.

    `protocol`: only these, on every channel, from beginning to end. Without it, each channel is read by the protocols that its first frames
    show, and by others as soon as they show.
    `fields`: instead, a row for each field with one of these names, such as `"uds.did"`, `"obd.*"`, or `"*"` for all.
    `faults`: only what went wrong.
    `db`: signals of the messages of J1939 and NMEA 2000. `pair`, `eds`, `odx`, `a2l`, `xcp`, `ccp`, `dsdl`, `subject`: what else is known about
    the bus, as the command's options (docs/protocols.md). What is not understood in these files causes a `CantapWarning`.

    The columns are in docs/python.md.
    """
    source = _unpacked(source)
    reader = _native.Conversations(_bus(protocol, fields, faults, db, pair, eds, odx, a2l, xcp, ccp, dsdl, subject))
    if _is_file(source):
        return reader.read(_options(source, None, (), filter, channel, start, end, format, zone, strict))
    if filter or channel != () or (start, end, format, zone) != (None,) * 4 or strict:
        raise ValueError("of a table its rows are chosen before")
    return reader.take(_table(source), False)


def _bus(
    protocol: Any,
    fields: Words,
    faults: bool,
    db: Databases | None,
    pair: Words,
    eds: Paths,
    odx: Paths,
    a2l: Paths,
    xcp: Words,
    ccp: Words,
    dsdl: Paths,
    subject: Words,
) -> Bus:
    return {
        "protocol": words(protocol, "protocol"),
        "fields": words(fields, "fields"),
        "faults": bool(faults),
        "db": None if db is None else _database(db),
        "pair": words(pair, "pair"),
        "eds": _paths(eds, "eds"),
        "odx": _paths(odx, "odx"),
        "a2l": _paths(a2l, "a2l"),
        "xcp": words(xcp, "xcp"),
        "ccp": words(ccp, "ccp"),
        "dsdl": _paths(dsdl, "dsdl"),
        "subject": words(subject, "subject"),
    }


def _paths(paths: Paths, argument: str) -> list[str]:
    """Names of files, also with a node in front (`5:drive.eds`) or a layer behind (`car.pdx:Engine`)."""
    if isinstance(paths, (str, os.PathLike)):
        return [os.fspath(paths)]
    if isinstance(paths, bytes) or not isinstance(paths, Iterable):
        raise TypeError(f"{argument} is the name of a file, or several of them, not {type(paths).__name__}")
    return [os.fspath(path) for path in paths]
