"""A bus for tests: simulated, in simulated time, or a device's; with scripts as nodes on it."""

from __future__ import annotations

import collections
import pathlib
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ._native import CantapError, Database, Frame, NodeBus, Record, channel_number, identifier, ready_nodes, seconds

if TYPE_CHECKING:
    from .device import Channel, Rate
    from .traces import Seconds

TRACE = 40
"""How many of the last frames are shown with a failure."""


class Received:
    """A frame that was on the bus."""

    def __init__(self, record: Record, time: float, signals: dict[str, Any]) -> None:
        self.record = record
        """All that is known of it."""
        self.time = time
        """Seconds since the bus was opened, by its clock."""
        self.signals = signals
        """Its values, if the database has it."""

    @property
    def id(self) -> int:
        """The identifier."""
        return self.record.id or 0

    @property
    def data(self) -> bytes:
        """The data bytes."""
        return self.record.data or b""

    def __getitem__(self, signal: str) -> Any:
        return self.signals[signal]

    def __repr__(self) -> str:
        return f"<cantap.bench.Received {self.time:.6f} {_text(self.record)}>"


class Node:
    """A node on a bus, made by `Bus.start`."""

    def __init__(self, bus: NodeBus, number: int, name: str) -> None:
        self._bus = bus
        self._number = number
        self.name = name
        """Its name: that of the ready node, or of its file."""

    def stop(self) -> None:
        """Takes it off the bus: it sends nothing more."""
        self._bus.end(self._number)


class Repeated:
    """A frame that is sent again and again, made by `Bus.periodic`."""

    def __init__(self, bus: Bus, handle: int, channel: int, period_ns: int) -> None:
        self._bus, self._handle, self._channel, self._period_ns = bus, handle, channel, period_ns

    def update(self, what: Frame | str, signals: dict[str, Any] | None = None) -> None:
        """Sends another frame from now on."""
        frame = self._bus._frame(what, signals)
        self._bus._native.repeat(self._handle, self._channel, frame, self._period_ns)

    def stop(self) -> None:
        """Sends it no more."""
        self._bus._native.repeat(self._handle, self._channel, None, 1)


class Bus:
    """A bus, and a place on it.

    Without an address, the bus is simulated and in simulated time: nothing happens on it but while `wait` or `expect` lets time
    pass, and a test takes as long as the computer needs. Otherwise it is that of a device's channel, which takes part in it.
    """

    def __init__(
        self,
        address: str | None = None,
        *,
        channel: Channel = 1,
        bitrate: Rate | None = None,
        db: Database | None = None,
        options: str = "load=0",
    ) -> None:
        self._native = NodeBus(address, channel, bitrate, options, db)
        self._channel, self._db = channel_number(channel), db
        self._begin_ns = self._native.now_ns()
        self._ahead: collections.deque[Record] = collections.deque()
        self._last: collections.deque[str] = collections.deque(maxlen=TRACE)
        self._handles = 0
        self.address = address
        """The device's address; `None` if the bus is simulated."""
        self.log: list[tuple[float, str, str]] = []
        """What nodes have logged: the time in seconds, the node, the text."""

    # Nodes

    def start(self, name: str, source: str | None = None, **settings: Any) -> Node:
        """Starts a node: a ready one by its name, such as `obd`, with its settings; a script's file; or a script's text.

        `ready_nodes()` lists those that are ready.
        """
        if source is None and name.endswith(".rhai"):
            source = pathlib.Path(name).read_text(encoding="utf-8")
        if source is not None and settings:
            raise ValueError("settings are those of a ready node; a script has its own text")
        if settings:
            name += "?" + "&".join(f"{setting}={_setting(value)}" for setting, value in settings.items())
        return Node(self._native, self._native.add(name, source), name)

    # Sending

    def send(self, what: Frame | str, signals: dict[str, Any] | None = None, *, channel: Channel | None = None) -> None:
        """Sends a frame, such as `"123#0102"`, or a message of the database with these signals."""
        frame = self._frame(what, signals)
        self._look()
        self._native.send(self._channel if channel is None else channel, frame)

    def periodic(
        self,
        what: Frame | str,
        period: Seconds,
        signals: dict[str, Any] | None = None,
        *,
        channel: Channel | None = None,
    ) -> Repeated:
        """Sends a frame now and then again after each period."""
        period_ns = round(seconds(period) * 1e9)
        if period_ns <= 0:
            raise ValueError(f"{period!r} is not a period; it is longer than nothing")
        self._handles += 1
        repeated = Repeated(self, self._handles, self._channel if channel is None else channel_number(channel), period_ns)
        repeated.update(what, signals)
        return repeated

    # Time

    @property
    def now(self) -> float:
        """Seconds since the bus was opened, by its clock: simulated time, or the device's."""
        return (self._native.now_ns() - self._begin_ns) / 1e9

    def wait(self, time: Seconds) -> None:
        """Lets time pass."""
        self._find(lambda _: False, time)

    def expect(
        self,
        what: int | str,
        within: Seconds,
        where: Callable[[Received], bool] | None = None,
        *,
        channel: Channel | None = None,
    ) -> Received:
        """The next such frame of another node; an `AssertionError` if there is none within this time of the bus's clock.

        `what`: an identifier, as a number or as in `"7E8"` (eight digits for one of 29 bits), or a message of the database. `where`
        may look at what was received. What was on the bus since the last call counts, too.
        """
        found = self._find(self._matcher(what, where, channel), within)
        if found is None:
            kind = "" if where is None else " of the kind that is expected"
            name = f"{what:03X}" if isinstance(what, int) else what
            raise AssertionError(f"no frame {name}{kind} within {within if isinstance(within, str) else f'{within} s'}")
        return found

    def expect_none(self, what: int | str, within: Seconds, *, channel: Channel | None = None) -> None:
        """Lets time pass; an `AssertionError` if there is such a frame."""
        found = self._find(self._matcher(what, None, channel), within)
        if found is not None:
            raise AssertionError(f"{found!r} is not expected")

    # Afterwards

    @property
    def trace(self) -> list[str]:
        """The last frames, each as candump writes it, with the seconds since the bus was opened."""
        self._look()
        return list(self._last)

    @property
    def errors(self) -> list[tuple[str, str]]:
        """Nodes that have ended with an error, and the error."""
        return self._native.errors()

    def close(self) -> None:
        """Ends all nodes and leaves the bus."""
        self._native.close()

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _frame(self, what: Frame | str, signals: dict[str, Any] | None) -> Frame:
        if isinstance(what, Frame):
            return what
        if "#" in what:
            return Frame.parse(what)
        if self._db is None:
            raise ValueError(f"{what!r} is no frame, such as '123#0102', and there is no database to find a message in")
        return self._db.encode(what, signals or {})

    def _matcher(
        self, what: int | str, where: Callable[[Received], bool] | None, channel: Channel | None
    ) -> Callable[[Received], bool]:
        wanted: Callable[[Received], bool]
        if isinstance(what, int):
            wanted = lambda received: received.id == what
        elif self._db is not None and what in self._db.message_names:
            wanted = lambda received: self._name(received.record) == what
        else:
            try:
                pair = identifier(what)
            except ValueError as error:
                raise ValueError(f"{what!r} is neither an identifier, such as '7E8', nor a message of the database: {error}") from None
            wanted = lambda received: (received.id, received.record.extended) == pair
        number = None if channel is None else channel_number(channel)
        return lambda received: (
            (number is None or received.record.channel == number)
            and wanted(received)
            and (where is None or bool(where(received)))
        )

    def _name(self, record: Record) -> str | None:
        found = self._db.decode(record, channel=record.channel) if self._db is not None else None
        return found[0] if found else None

    def _take(self, record: Record) -> Received:
        time = (record.time_ns - self._begin_ns) / 1e9
        signals: dict[str, Any] = {}
        if self._db is not None and record.event == "frame":
            found = self._db.decode(record, channel=record.channel)
            signals = found[1] if found else {}
        self._last.append(f"({time:.6f}) can{record.channel - 1} {_text(record)}")
        return Received(record, time, signals)

    def _look(self) -> None:
        """Looks at everything that was on the bus by now."""
        records = [*self._ahead, *self._native.advance(0)]
        self._ahead.clear()
        for record in records:
            self._take(record)
        self._collect()

    def _collect(self) -> None:
        self.log += self._native.messages()

    def _find(self, wanted: Callable[[Received], bool], within: Seconds) -> Received | None:
        until_ns = self._native.now_ns() + round(seconds(within) * 1e9)
        is_over = False
        try:
            while True:
                while self._ahead:
                    if self._ahead[0].time_ns > until_ns:
                        return None
                    record = self._ahead.popleft()
                    received = self._take(record)
                    if record.event == "frame" and record.direction == "rx" and wanted(received):
                        return received
                self._ahead.extend(self._native.advance(until_ns))
                if not self._ahead:
                    if is_over:
                        return None
                    # What was under way then may still arrive.
                    is_over = self._native.now_ns() >= until_ns
        finally:
            self._collect()


def _setting(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _text(record: Record) -> str:
    if record.event != "frame" or record.id is None:
        return f"{record.event} {record.detail or ''}".strip()
    id = f"{record.id:08X}" if record.extended else f"{record.id:03X}"
    return f"{id}#R{record.dlc}" if record.remote else f"{id}#{(record.data or b'').hex().upper()}"


__all__ = ["Bus", "CantapError", "Node", "Received", "Repeated", "ready_nodes"]
