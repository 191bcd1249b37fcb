"""CAN buses and traces: the cantap analyser, trace files of every common format, signals as Arrow tables.

`open` begins a session with the analyser; `read` and `scan` take a trace of any format and, with a
database, return decoded signals.
"""

from ._columns import Column, Row, Schema
from ._native import (
    CantapError,
    CantapWarning,
    DatabaseError,
    DeviceError,
    FormatError,
    Frame,
    Odx,
    PeriodicFrame,
    Record,
    Records,
    Reply,
    Report,
    Scan,
    Table,
    __version__,
)
from ._conversations import conversations
from .device import Checksum, Counter, Device, RandomByte, boards, open, selftest
from .diagnostics import Ecu, NegativeResponse, load_odx
from .traces import Database, Messages, dataset, decode, encode, load_database, read, scan, search, stats, write

__all__ = [
    "CantapError",
    "CantapWarning",
    "Checksum",
    "Column",
    "Counter",
    "Database",
    "DatabaseError",
    "Device",
    "DeviceError",
    "Ecu",
    "FormatError",
    "Frame",
    "Messages",
    "NegativeResponse",
    "Odx",
    "PeriodicFrame",
    "RandomByte",
    "Record",
    "Records",
    "Reply",
    "Report",
    "Row",
    "Scan",
    "Schema",
    "Table",
    "__version__",
    "boards",
    "conversations",
    "dataset",
    "decode",
    "encode",
    "load_database",
    "load_odx",
    "open",
    "read",
    "scan",
    "search",
    "selftest",
    "stats",
    "write",
]
