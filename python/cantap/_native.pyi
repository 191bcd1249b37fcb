"""The compiled half. What is documented for users is in `cantap` itself."""

import os
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any, NotRequired, SupportsIndex, TypedDict, final, overload, type_check_only

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
from matplotlib.axes import Axes

from ._columns import Column, Row, Schema
from ._sources import TraceFile
from .traces import Seconds

__all__ = [
    "CantapError",
    "CantapWarning",
    "Conversations",
    "Database",
    "DatabaseError",
    "Device",
    "DeviceError",
    "FormatError",
    "Frame",
    "NodeBus",
    "Odx",
    "PeriodicFrame",
    "Reading",
    "Record",
    "Records",
    "Reply",
    "Report",
    "Scan",
    "Table",
    "__version__",
    "ask_ecu",
    "bit_rate",
    "channel_number",
    "decode_table",
    "disturb",
    "divide",
    "encode_tables",
    "identifier",
    "is_trace_name",
    "list_boards",
    "ready_nodes",
    "refusal_text",
    "search",
    "seconds",
    "selftest",
    "stats",
    "table_of_messages",
    "write",
]

__version__: str

class CantapError(Exception):
    """The base of all errors of this package."""

class DeviceError(CantapError):
    """A device could not be opened, refused a request, or is gone."""

class FormatError(CantapError):
    """A file is not a trace in a format that can be read or written."""

class DatabaseError(CantapError):
    """A signal database cannot be used, or does not fit."""

class CantapWarning(UserWarning):
    """Something was left out, but the rest can be used."""

@type_check_only
class Options(TypedDict):
    files: list[TraceFile]
    db: Database | None
    signals: list[str]
    filters: list[str]
    channels: list[int | str]
    start: str | None
    end: str | None
    format: str | None
    zone: str | None
    strict: bool
    indexes: NotRequired[str]

@type_check_only
class Bus(TypedDict):
    protocol: list[str]
    fields: list[str]
    faults: bool
    db: Database | None
    pair: list[str]
    eds: list[str]
    odx: list[str]
    a2l: list[str]
    xcp: list[str]
    ccp: list[str]
    dsdl: list[str]
    subject: list[str]

@final
class Conversations:
    """Records in, what they say out."""

    def __new__(cls, wanted: Bus) -> Conversations: ...
    def read(self, options: Options) -> Table:
        """What a trace says, from its beginning to its end."""
    def take(self, table: Any, more: bool) -> Table:
        """What the records of a table complete; with `more` others follow."""
    def finish(self) -> Table:
        """What was in progress at the end."""

@final
class Database:
    """Compiled databases: loaded once, used for any number of traces, devices and frames, in any thread."""

    def __new__(cls, files: list[tuple[int | str | None, str | os.PathLike[str]]], j1939: bool) -> Database: ...
    @staticmethod
    def of_virtual_car() -> Database:
        """The database of the virtual car (`virtual:car`)."""
    @property
    def warnings(self) -> list[str]:
        """What is wrong with the files although they are usable."""
    @property
    def message_names(self) -> list[str]:
        """The names of all messages."""
    def encode(
        self, message: str, signals: dict[str, Any] | None = None, *, channel: int | str | None = None
    ) -> Frame:
        """The frame of a message with these values: numbers, or texts of the signals' tables. The others have the database's start value,
        or 0."""
    def decode(self, frame: Any, *, channel: int | str = ...) -> tuple[str, dict[str, float | str | None]] | None:
        """The name of a frame's message, and its values by signal: `Gear` is the number, `Gear.text` the text of its table. `None` if no
        database has it, and for an error frame. `frame` is a `Frame`, a `Record`, a text, or a message of python-can.
        `channel`, by which a database is chosen, is 1 unless it is given."""
    def _schema_of(self, message: str, signals: list[str]) -> Table: ...
    def _signal_names(self) -> set[str]: ...
    def signals_of(self, message: str) -> list[dict[str, str]]:
        """The signals of a message: `name`, `unit` and `description` of each."""

@final
class Report:
    """What was read from a file, and what could not be read."""

    @property
    def file(self) -> str:
        """The file's name, as given."""
    @property
    def format(self) -> str:
        """The format as which it was read."""
    @property
    def records_read(self) -> int:
        """Records in the file, before any filter."""
    @property
    def channels(self) -> list[int]:
        """The channels that the file has, before any filter."""
    @property
    def records(self) -> int:
        """Records that passed the filters."""
    @property
    def frames(self) -> int:
        """Frames among them."""
    @property
    def lost(self) -> int:
        """Frames that are missing according to the trace."""
    @property
    def lost_at_least(self) -> bool:
        """Whether there may be more missing than `lost`."""
    @property
    def bus_errors(self) -> int:
        """Bus errors, including those that were only counted."""
    @property
    def decoded(self) -> int:
        """Frames that a database has a message for."""
    @property
    def values(self) -> int:
        """Values in them."""
    @property
    def issues(self) -> int:
        """Places that could not be read."""
    @property
    def faults(self) -> list[str]:
        """The first twenty of them, in words."""
    @property
    def is_cut(self) -> bool:
        """Whether the file ends in the middle of something."""
    @property
    def left_out(self) -> dict[str, int]:
        """What is well-formed but not part of a CAN trace, by kind."""
    @property
    def notes(self) -> dict[str, int]:
        """What is not wrong but should be known, by kind."""
    @property
    def properties(self) -> dict[str, str]:
        """What an MF4 file says about its measurement, by name: device, session, author, the program that wrote it."""
    @property
    def files(self) -> list[Report]:
        """The reports of the single files, if there were several."""
    @property
    def missing_pct(self) -> float:
        """The percentage of the file's entries that could not be read or were left out."""
    @property
    def is_whole(self) -> bool:
        """Whether the file was read to its end and every place of it could be read."""
    def to_dict(self) -> dict[str, Any]:
        """Everything as a dictionary."""

@final
class Table:
    """A table in memory; any Arrow program takes it without copying."""

    @property
    def num_rows(self) -> int:
        """The number of rows."""
    @property
    def column_names(self) -> tuple[str, ...]:
        """The columns' names, in order."""
    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of the table: for example, its message."""
    @property
    def report(self) -> Report | None:
        """What was read, and what could not be read; `None` for a table that was not read from a file."""
    def column_metadata(self, name: str) -> dict[str, str]:
        """Metadata of a column: its unit, its description."""
    def batches(self) -> list[Table]:
        """The pieces in which the table is held in memory."""
    def to_numpy(self) -> dict[str, np.ndarray[Any, Any]]:
        """The columns as NumPy arrays: times as datetime64, texts as objects, data bytes as a row of numbers for each frame.

        Missing values are masked.
        """
    def to_pyarrow(self) -> pa.Table:
        """The same table for pyarrow."""
    def to_pandas(self) -> pd.DataFrame:
        """The same table for pandas."""
    def to_polars(self) -> pl.DataFrame:
        """The same table for Polars."""
    @property
    def schema(self) -> Schema:
        """The columns by name, each with its type."""
    @overload
    def __getitem__(self, key: str, /) -> Column: ...
    @overload
    def __getitem__(self, key: slice | list[str], /) -> Table: ...
    @overload
    def __getitem__(self, key: SupportsIndex, /) -> Row: ...
    def __iter__(self) -> Iterator[Row]: ...
    def __contains__(self, key: object, /) -> bool: ...
    def _ipython_key_completions_(self) -> tuple[str, ...]: ...
    def plot(self, *signals: str, ax: Axes | None = None, **options: Any) -> Axes:
        """Plots signals over time with Matplotlib, as steps; all of them if none is named. `options` are those of `Axes.plot`."""
    def _repr_html_(self) -> str: ...
    def _values(self, name: str) -> list[Any]: ...
    def _parts(self, name: str) -> tuple[str, bytes, bytes | None, list[str] | None, int]: ...
    def __len__(self) -> int: ...
    def __arrow_c_schema__(self) -> object: ...
    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object: ...
    def __arrow_c_array__(self, requested_schema: object | None = None) -> tuple[object, object]: ...

@final
class Scan(Iterator[Table]):
    """A trace being read, batch by batch: memory does not grow with the file."""

    def __new__(cls, options: Options, batch_rows: int) -> Scan: ...
    @property
    def report(self) -> Report:
        """What was read so far, and what could not be read."""
    @property
    def column_names(self) -> tuple[str, ...]:
        """The columns' names, in order."""
    def read_all(self) -> Table:
        """The rest, as one table."""
    def _count(self) -> int: ...
    def close(self) -> None:
        """Closes the file."""
    def __iter__(self) -> Scan: ...
    def __next__(self) -> Table: ...
    def __enter__(self) -> Scan: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None: ...
    def __arrow_c_schema__(self) -> object: ...
    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object: ...

@final
class Frame:
    """A CAN frame: classical, or of CAN FD (`fd`, `brs` or `esi`). `id` is a number, or a text such as `"1A1"` or `"000001A1"`, whose digits say
    how many bits it has; or a whole frame, `"1A1#00"`."""

    def __new__(
        cls,
        id: int | str,
        data: bytes | bytearray | list[int] | None = None,
        *,
        extended: bool | None = None,
        remote: bool = False,
        dlc: int | None = None,
        fd: bool = False,
        brs: bool = False,
        esi: bool = False,
    ) -> Frame: ...
    @staticmethod
    def parse(text: str) -> Frame:
        """Parses a frame as `cantap send` takes it: `123#1122`, `1#00`, `0x18FEF100#11.22`, `00000123#R3`, `123##11122`."""
    @property
    def id(self) -> int:
        """The identifier."""
    @property
    def extended(self) -> bool:
        """Whether the identifier has 29 bits."""
    @property
    def remote(self) -> bool:
        """Whether it asks for data and has none."""
    @property
    def fd(self) -> bool:
        """Whether it is a CAN FD frame."""
    @property
    def brs(self) -> bool:
        """Whether its data have a bit rate of their own."""
    @property
    def esi(self) -> bool:
        """Whether it says that its sender is error passive."""
    @property
    def dlc(self) -> int:
        """The length code, as on the bus."""
    @property
    def data(self) -> bytes:
        """The data bytes."""
    def __hash__(self) -> int: ...
    def __eq__(self, other: object, /) -> bool: ...

@final
class Record:
    """An event on a bus: a frame, an error, a loss."""

    @property
    def time_s(self) -> float:
        """Seconds since 1970, UTC."""
    @property
    def time_ns(self) -> int:
        """Nanoseconds since 1970, UTC. For a frame it is the end."""
    @property
    def device_ns(self) -> int | None:
        """The same moment by the device's own clock, in nanoseconds, corrected by nothing; `None` where it is not known."""
    @property
    def channel(self) -> int:
        """The channel, from 1."""
    @property
    def event(self) -> str:
        """The kind of event: `frame`, `lost`, `bus-error`, `errors-suppressed`, `state`, `transmit-failed`,
        `disturbed`, `lin`."""
    @property
    def detail(self) -> str | None:
        """Where frames were lost, which error, which state, why not sent, what was wrong with a LIN frame."""
    @property
    def count(self) -> int | None:
        """Frames lost, errors suppressed, periods that passed; of a disturbance the nanoseconds, 0 if it came to nothing; of a LIN frame its
        checksum."""
    @property
    def at_least(self) -> bool:
        """Whether more may have been lost."""
    @property
    def id(self) -> int | None:
        """The frame's identifier, of a LIN frame too."""
    @property
    def extended(self) -> bool:
        """Whether it has 29 bits."""
    @property
    def remote(self) -> bool:
        """Whether the frame asks for data and has none."""
    @property
    def fd(self) -> bool:
        """Whether it is a CAN FD frame."""
    @property
    def brs(self) -> bool:
        """Whether its data had a bit rate of their own."""
    @property
    def esi(self) -> bool:
        """Whether it says that its sender is error passive."""
    @property
    def dlc(self) -> int | None:
        """The frame's length code, as on the bus."""
    @property
    def data(self) -> bytes | None:
        """The frame's data bytes, of a LIN frame too."""
    @property
    def direction(self) -> str | None:
        """`rx` or `tx`, for a frame."""
    @property
    def late(self) -> bool:
        """Whether the time is only an upper bound: the frame ended then or earlier."""
    def __hash__(self) -> int: ...
    def __eq__(self, other: object, /) -> bool: ...

@final
class Records(Iterator[Record]):
    """The records of a device from the time at which this was made."""

    def __iter__(self) -> Records: ...
    def __next__(self) -> Record: ...
    def read(self, timeout: Seconds | None = None) -> Record | None:
        """The next record; `None` if there is none within `timeout` seconds, or after the last."""
    def batch(self, seconds: Seconds | None = None, rows: int = 65_536) -> Table:
        """Records of the next `seconds`, at most `rows`, as a table; without `seconds` it waits until there are so many."""
    @property
    def lost(self) -> tuple[int, int]:
        """Frames lost here because this program did not take them, on channels 1 and 2."""
    def fileno(self) -> int:
        """A file descriptor that is readable while a record is waiting."""
    def close(self) -> None:
        """Stops listening; waiting records can still be read."""
    def _messages(
        self, timeout: Seconds | None
    ) -> list[
        tuple[float, int, bool, bool, bool, int, int, bytearray, bool, bool, bool, bool]
    ]: ...
    def _used_up(self) -> None: ...
    def _filter(self, filters: list[str]) -> None: ...

@final
class NodeBus:
    def __new__(
        cls,
        address: str | None,
        channel: int | str,
        bitrate: int | str | None,
        options: str,
        database: Database | None,
    ) -> NodeBus: ...
    def add(self, name: str, source: str | None) -> int: ...
    def end(self, node: int) -> None: ...
    def send(self, channel: int | str, frame: Frame | str) -> None: ...
    def repeat(self, handle: int, channel: int | str, frame: Frame | str | None, period_ns: int) -> None: ...
    def now_ns(self) -> int: ...
    def advance(self, until_ns: int) -> list[Record]: ...
    def messages(self) -> list[tuple[float, str, str]]: ...
    def errors(self) -> list[tuple[str, str]]: ...
    def close(self) -> None: ...

def ready_nodes() -> list[tuple[str, str]]:
    """The ready nodes: the name of each, and what it is."""

@final
class Odx:
    """What PDX packages and ODX documents say of ECUs: names of requests, and the values of their answers."""

    def __new__(cls, files: list[str | os.PathLike[str]]) -> Odx: ...
    @property
    def warnings(self) -> list[str]:
        """What is not evaluated, in words."""
    @property
    def ecus(self) -> list[tuple[str, list[str]]]:
        """The ECUs: the name of each, and the pairs of its identifiers."""
    def requests(self, pair: str) -> dict[str, tuple[bytes, list[str]]]:
        """The requests of an ECU, `7E0:7E8`, by name: their bytes, and what else whoever asks has to give."""
    def _only_pair(self) -> str | None: ...
    def _request(self, pair: str, name: str, begins: bytes) -> bytes: ...
    def _values(self, pair: str, request: bytes, answer: bytes) -> tuple[dict[str, Any], str | None]: ...

@final
class PeriodicFrame:
    """A frame that the device sends repeatedly, until this is stopped or dropped."""

    @property
    def is_running(self) -> bool:
        """Whether it is still active, apart from any limit to its count."""
    def update(self, frame: Frame | str) -> None:
        """Sends another frame from now on."""
    def stop(self) -> None:
        """Stops it."""

@final
class Reply:
    """A frame that the device sends whenever it receives a matching one, until this is stopped or dropped."""

    @property
    def is_running(self) -> bool:
        """Whether it is still active, apart from any limit to its count."""
    def stop(self) -> None:
        """Stops it."""

@final
class Device:
    def __new__(cls, address: str) -> Device: ...
    @property
    def address(self) -> str: ...
    @property
    def closed(self) -> bool: ...
    @property
    def is_virtual_car(self) -> bool: ...
    def info(self) -> dict[str, Any]: ...
    def open_channel(self, number: int | str, options: dict[str, Any]) -> tuple[int | None, str | None]: ...
    def keep_intervals(self) -> None: ...
    def autobaud(self, number: int | str, silence: Seconds) -> int: ...
    def close_channel(self, number: int | str) -> None: ...
    def open_channels(self) -> dict[int, dict[str, Any]]: ...
    def records(
        self,
        channel_number: int | str | None = None,
        filters: list[str] = ...,
        only_received: bool = False,
        capacity: int = ...,
        node: int | None = None,
    ) -> Records: ...
    def send(
        self,
        number: int | str,
        frames: list[Frame | str] | list[Frame],
        timeout: Seconds | None,
        at_ns: int | None = None,
        queue_timeout: float = 1.0,
        node: int = ...,
    ) -> list[int]: ...
    def send_now(self, number: int | str, frame: Frame | str, node: int) -> bool: ...
    def reopen(self, number: int | str, filters: list[str]) -> None: ...
    def abort(self, number: int | str) -> None: ...
    def periodic(
        self,
        number: int | str,
        frame: Frame | str,
        period: Seconds,
        count: int,
        modifiers: list[tuple[str, int, int, int, str]],
        node: int = ...,
    ) -> PeriodicFrame: ...
    def reply(
        self,
        number: int | str,
        to: tuple[int | str, int | str | None, bool | None],
        frame: Frame | str,
        count: int,
    ) -> Reply: ...
    def status(self) -> dict[str, Any]: ...
    def losses(self) -> dict[int, dict[str, int]]: ...
    def start_gateway(self, rules: str | os.PathLike[str]) -> None: ...
    def stop_gateway(self) -> None: ...
    def gateway(self) -> dict[str, Any]: ...
    def clock(self) -> dict[str, Any]: ...
    def time_ns(self) -> int: ...
    def recover(self, number: int | str) -> None: ...
    def identify(self, time: Seconds) -> None: ...
    def close(self) -> None: ...

def bit_rate(rate: int | str) -> int: ...
def channel_number(channel: int | str) -> int: ...
def identifier(id: int | str) -> tuple[int, bool]: ...
def seconds(time: Seconds) -> float: ...
def list_boards() -> list[tuple[str, str | None, str | None]]: ...

def stats(
    options: Options,
    bitrates: list[tuple[int | str | None, int | str]],
    data_bitrates: list[tuple[int | str | None, int | str]],
    window: Seconds,
) -> dict[str, Any]: ...
@final
class Reading:
    """A trace that a thread reads ahead, to be decoded."""

    def __new__(cls, options: Options) -> Reading: ...
    def decode(
        self, db: Database, signals: list[str], warns: bool = True
    ) -> tuple[tuple[list[tuple[str, Table]], Table], Report]:
        """A table for each message, and one for events other than frames; once."""

def decode_table(
    table: Any, db: Database, signals: list[str]
) -> tuple[list[tuple[str, Table]], Table]: ...
def ask_ecu(
    device: Device,
    number: int | str,
    pair: str,
    is_to_all: bool,
    data: bytes,
    times: tuple[Seconds, Seconds, Seconds],
    padding: int | None,
) -> list[tuple[str, bytes]]: ...
def disturb(
    device: Device,
    number: int | str,
    at: Seconds | None,
    id: int | str | None,
    nth: int | None,
    length: int,
    count: int,
    every: Seconds,
) -> list[dict[str, Any]]: ...
def divide(path: str | os.PathLike[str], options: Options, part_bytes: int) -> list[tuple[int | None, int | None, int]] | None: ...
def encode_tables(tables: list[tuple[str, Any]], db: Database) -> Table: ...
def is_trace_name(name: str | os.PathLike[str]) -> bool: ...
def refusal_text(service: int, code: int) -> tuple[str, str]: ...
def table_of_messages(messages: Iterable[Any]) -> Table: ...
def search(
    options: Options, condition: str | None, ids: list[str], data: list[str], max_count: int | None
) -> Table: ...
def selftest(address: str | None, has_loop: bool, load_time: Seconds, restarts: bool) -> dict[str, Any]: ...
def write(
    table: Any,
    path: str | os.PathLike[str],
    format: str | None,
    zone: str | None,
    decoder: tuple[Database, list[str]] | None,
) -> dict[str, int]: ...
