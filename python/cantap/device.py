"""The analyser, live."""

from __future__ import annotations

import atexit
import datetime
import numbers
import os
import weakref
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any, Literal, SupportsIndex, TypeAlias

from . import _native
from ._arguments import channels as _channels
from ._arguments import words as _words
from ._native import Frame, PeriodicFrame, Record, Records, Reply, Table
from .diagnostics import Ecu

Mode: TypeAlias = Literal["listen-only", "normal", "loopback", "silent-loopback"]
AnyFrame: TypeAlias = "Frame | str"
ChecksumName: TypeAlias = Literal["xor", "sum", "crc8-j1850"]

CAPACITY = 1 << 20
"""How many records may wait for a busy program: half a minute of two saturated channels."""

_open: weakref.WeakSet[Device] = weakref.WeakSet()


class Counter:
    """Counts up in `bits` bits of byte `byte` (from 0), from bit `low_bit` up, before each transmission."""

    def __init__(self, byte: int, low_bit: int = 0, bits: int = 8) -> None:
        self.words = ("counter", byte, low_bit, bits, "")


class Checksum:
    """Puts a checksum over all other data bytes into byte `byte` (from 0) before each transmission."""

    def __init__(self, byte: int, algorithm: ChecksumName = "crc8-j1850") -> None:
        self.words = ("checksum", byte, 0, 0, algorithm)


class RandomByte:
    """Puts a new random value into byte `byte` (from 0) before each transmission."""

    def __init__(self, byte: int) -> None:
        self.words = ("random", byte, 0, 0, "")


class Device:
    """A device in a session of this program, made by `open`.

    Nothing is sent or acknowledged until a channel is opened in a mode other than `listen-only`. When the session ends, for
    whatever reason, the channels close and the device stops sending on its own.
    """

    def __init__(self, address: str, *, capacity: int = CAPACITY) -> None:
        self._native = _native.Device(address)
        self._records = self._native.records(capacity=capacity)
        _open.add(self)

    @property
    def address(self) -> str:
        """Its address, as given when it was opened."""
        return self._native.address

    @property
    def closed(self) -> bool:
        """Whether it is closed."""
        return self._native.closed

    @property
    def info(self) -> dict[str, Any]:
        """The device's description: board, serial number, versions, clocks, sizes of its tables."""
        return self._native.info()

    # Channels

    def open_channel(
        self,
        channel: int,
        bitrate: int | Literal["auto"] | None = None,
        *,
        mode: Mode = "listen-only",
        sample_point: float | None = None,
        sjw: int | None = None,
        segments: tuple[int, int, int, int] | None = None,
        one_shot: bool = False,
        manual_recovery: bool = False,
        filter: str | Iterable[str] = (),
    ) -> int:
        """Opens a channel, 1 or 2, and returns its bit rate in bit/s.

        Without a bit rate, the one saved on the device is used; the virtual device's buses have 500 kbit/s. `"auto"` finds it by
        listening, see `autobaud`.
        `sample_point` is in per cent; `segments` is prescaler, segment 1, segment 2 and jump width, instead of a bit rate.
        `filter` as with `cantap.read`: the device drops other frames in hardware as far as it can, and this computer drops the rest.
        """
        if bitrate == "auto":
            bitrate = self.autobaud(channel)
        rate, _ = self._native.open_channel(
            channel,
            {
                "bitrate": bitrate,
                "mode": mode,
                "sample_point": sample_point,
                "sjw": sjw,
                "segments": segments,
                "one_shot": one_shot,
                "manual_recovery": manual_recovery,
                "filters": _words(filter, "filter"),
            },
        )
        return rate

    def autobaud(self, channel: int, *, timeout: float = 10.0) -> int:
        """Finds the bit rate of a channel's bus, in bit/s, without sending anything: one frame is enough. The channel must be closed.

        The rate found before on this channel is tried first. Raises `DeviceError`, with what to check, if there is no traffic for
        `timeout` seconds, or none that a bit rate can be found from.
        """
        return self._native.autobaud(channel, timeout)

    def ecu(
        self,
        channel: int,
        request: int = 0x7E0,
        response: int | None = None,
        *,
        to_all: bool = False,
        p2: float = 1.0,
        p2_star: float = 5.0,
        timeout: float = 30.0,
        padding: int | None = 0,
    ) -> Ecu:
        """An ECU to ask, over UDS, KWP2000 or OBD-II. The channel must be open with `mode="normal"`.

        `request`, `response`: the identifiers. The response's is 8 more, or of 29 bits (18DAxxyy) the same with both addresses exchanged,
        unless it is given. `to_all`: requests go to all ECUs at once. `p2`: seconds until an answer begins; `p2_star`: the same after the
        ECU has said that it is pending; `timeout`: for everything. `padding`: the byte that fills frames up; `None` keeps them short.
        """
        if response is None:
            is_normal_fixed = request >> 16 == 0x18DA
            swapped = request & ~0xFFFF | (request & 0xFF) << 8 | request >> 8 & 0xFF
            response = swapped if is_normal_fixed else request + 8
        pair = ":".join(_id_text(id) for id in (request, response))
        return Ecu(self._native, channel, pair, to_all, (p2, p2_star, timeout), padding)

    def close_channel(self, channel: int) -> None:
        """Closes a channel, after everything it captured has arrived."""
        self._native.close_channel(channel)

    @property
    def channels(self) -> dict[int, dict[str, Any]]:
        """The open channels, each with `bitrate` and `mode`."""
        return self._native.open_channels()

    def recover(self, channel: int) -> None:
        """Brings a channel that was opened with `manual_recovery` back from bus-off."""
        self._native.recover(channel)

    # Listening

    def __iter__(self) -> Iterator[Record]:
        """Records as they arrive: frames, errors, states, losses. Ends when the device is closed."""
        return self._records

    def read(self, timeout: float | None = None) -> Record | None:
        """The next record; `None` if there is none within `timeout` seconds, or after the last."""
        return self._records.read(timeout)

    def batch(self, seconds: float | None = None, rows: int = 65_536) -> Table:
        """Records of the next `seconds`, at most `rows`, as a table; without `seconds` it waits until there are so many."""
        return self._records.batch(seconds, rows)

    def batches(self, seconds: float = 0.1, rows: int = 65_536) -> Iterator[Table]:
        """Tables of what arrived in the last `seconds` or so, one after the other, until the device is closed. None is empty."""
        while not self.closed:
            table = self._records.batch(seconds, rows)
            if len(table):
                yield table

    def records(
        self,
        channel: int | None = None,
        *,
        filter: str | Iterable[str] = (),
        only_received: bool = False,
        capacity: int = CAPACITY,
    ) -> Records:
        """Another stream of records, from now on: optionally of one channel, of some frames, or without those that this device sends.

        If they are not taken, frames are lost once `capacity` records are waiting: they are counted, and a loss takes their place.
        """
        filters = _words(filter, "filter")
        return self._native.records(channel, filters, only_received, capacity)

    # Sending

    def send(
        self,
        channel: int,
        frames: AnyFrame | Iterable[AnyFrame],
        *,
        timeout: float | None = 1.0,
        at: float | datetime.datetime | None = None,
    ) -> list[float]:
        """Sends a frame or several, in order, and returns when each was on the bus, in seconds since 1970.

        If they are not sent within `timeout` seconds, they are withdrawn, with everything else that the channel still had to send,
        and `DeviceError` is raised. With `timeout=None` the frames are only passed to the device.
        `at`: not before this time, in seconds since 1970 or a date with a time zone; at once if it is over. The device does the
        timing, and `timeout` includes the time until then.
        """
        # What is neither is refused there.
        one = isinstance(frames, (Frame, str, bytes)) or not isinstance(frames, Iterable)
        all_frames: list[Any] = [frames] if one else list(frames)  # type: ignore[arg-type]
        at_ns = None if at is None else _ns(at)
        return [time_ns / 1e9 for time_ns in self._native.send(channel, all_frames, timeout, at_ns)]

    def abort(self, channel: int) -> None:
        """Withdraws what a channel still has to send."""
        self._native.abort(channel)

    def send_periodic(
        self,
        channel: int,
        frame: AnyFrame,
        period: float,
        *,
        count: int = 0,
        modifiers: Iterable[Counter | Checksum | RandomByte] = (),
    ) -> PeriodicFrame:
        """Has the device send a frame every `period` seconds by its own timer, `count` times or until it is stopped.

        `modifiers` change its data before each transmission, in this order: `[Counter(0, bits=4), Checksum(7)]`.
        """
        one = isinstance(modifiers, (Counter, Checksum, RandomByte))
        if one or not isinstance(modifiers, Iterable):
            raise TypeError("modifiers are several: put them into a list, such as [Counter(0)]")
        words = []
        for modifier in modifiers:
            if not isinstance(modifier, (Counter, Checksum, RandomByte)):
                raise TypeError(f"a modifier is a Counter, Checksum or RandomByte, not {type(modifier).__name__}")
            words.append(modifier.words)
        return self._native.periodic(channel, frame, period, count, words)

    def reply(
        self,
        channel: int,
        id: int,
        frame: AnyFrame,
        *,
        mask: int | None = None,
        extended: bool | None = None,
        count: int = 0,
    ) -> Reply:
        """Has the device send a frame whenever it receives one with this identifier, within microseconds, until it is stopped."""
        return self._native.reply(channel, (id, mask, extended), frame, count)

    # Gateway

    def start_gateway(self, rules: str | os.PathLike[str]) -> None:
        """Passes frames on between the two channels, by a file of rules (docs/gateway.md), until `stop_gateway` or `close`.

        Both channels must be open with `mode="normal"`. The device does it: a slow program does not delay a frame. If it finds that both
        channels are on one bus it ends on its own, and a record has the event `transmit-failed` and the detail `loop`.
        """
        self._native.start_gateway(rules)

    def stop_gateway(self) -> None:
        """Ends the gateway. What waits in it is lost, and counted."""
        self._native.stop_gateway()

    @property
    def gateway(self) -> dict[str, Any]:
        """What the gateway does (`state`) and the counts of each direction and rule, as `cantap gateway --json` prints them."""
        return self._native.gateway()

    # State

    @property
    def status(self) -> dict[str, Any]:
        """The status of the device and its channels: states, error counters, queues."""
        return self._native.status()

    @property
    def losses(self) -> dict[int, dict[str, int]]:
        """Frames received and lost since the session began, by channel: at the controller, in the queue, on the link, here.

        `host` is what this session's own reader lost; the losses of a stream of records are in `Records.lost`. `unknown` is how often an
        unknown number was lost, or may have been: once for each channel that is opened on an adapter that does not count its losses.
        `off_bus` is how often the device was off the bus because another client of its server changed the mode, and `off_bus_ns` for how
        long. `lost` contains neither: only without both is it the whole.
        """
        return self._native.losses()

    @property
    def clock(self) -> dict[str, Any]:
        """What is known about the device's clock: `drift_ppm`, `uncertainty_ns`, what measures it."""
        return self._native.clock()

    def time(self) -> float:
        """The device's time, in seconds since 1970."""
        return self._native.time_ns() / 1e9

    def identify(self, seconds: int = 5) -> None:
        """Shows an LED pattern, to find the board among others."""
        self._native.identify(seconds)

    def close(self) -> None:
        """Closes the channels and ends the session. Records already received can still be read."""
        self._native.close()
        _open.discard(self)

    def __enter__(self) -> Device:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return "<cantap.Device, closed>" if self.closed else f"<cantap.Device at {self.address}>"

    def __reduce__(self) -> Any:
        raise TypeError("a device cannot be pickled; open it where it is used")


def _id_text(id: int) -> str:
    """As the command reads it: eight digits have 29 bits."""
    if not 0 <= id <= 0x1FFFFFFF:
        raise ValueError(f"{id:#X} is not an identifier; 0x7FF is the last standard one, 0x1FFFFFFF the last extended one")
    return f"{id:03X}" if id <= 0x7FF else f"{id:08X}"


def _ns(at: float | datetime.datetime) -> int:
    """Nanoseconds since 1970."""
    if isinstance(at, datetime.datetime):
        if at.tzinfo is None:
            raise ValueError(f"{at} has no time zone; give it one")
        # Exact, other than its `timestamp`.
        since = at - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
        return since // datetime.timedelta(microseconds=1) * 1000
    if not isinstance(at, numbers.Real):
        raise TypeError(f"a send time is a number or a datetime, not {type(at).__name__}")
    # Year 2242; nobody plans that far ahead, and later ones do not fit.
    if not -8.6e9 < at < 8.6e9:
        raise ValueError(f"{at} is not a send time; give seconds since 1970")
    return round(at * 1e9)


@atexit.register
def _close_all() -> None:
    """A program that ends leaves its buses in order."""
    for device in list(_open):
        try:
            device.close()
        except _native.CantapError:
            pass  # It is gone, or another process's.


def open(
    address: str,
    bitrate: int | Literal["auto"] | None = None,
    *,
    channels: SupportsIndex | Iterable[SupportsIndex] | None = None,
    mode: Mode = "listen-only",
    filter: str | Iterable[str] = (),
    capacity: int = CAPACITY,
    device_intervals: bool = False,
) -> Device:
    """Begins a session with the device at an address, as for the command's `-d`.

    `/dev/ttyACM0`, `COM5`, `virtual`, `virtual:car`, `unix:`, `tcp://HOST`, `tls://HOST`, `ssh://[USER@]HOST`.

    With `device_intervals`, intervals between times are those that the device's crystal measures; otherwise times follow UTC, and corrections change the
    intervals around them, by up to 100 ppm.

    With a bit rate, or `"auto"`, the `channels` are opened, or all that the device has. Without one, none is: use `Device.open_channel` for each.

        with cantap.open("/dev/ttyACM0", 500_000) as device:
            for record in device:
                print(record)
    """
    device = Device(address, capacity=capacity)
    if device_intervals:
        device._native.keep_intervals()
    if bitrate is not None:
        try:
            filters = _words(filter, "filter")
            every = range(1, device.info["channels"] + 1)
            for channel in every if channels is None else _channels(channels):
                device.open_channel(channel, bitrate, mode=mode, filter=filters)
        except BaseException:
            device.close()
            raise
    return device


def boards() -> list[dict[str, str | None]]:
    """The boards connected to this computer: `port`, `serial`, `product`."""
    return [
        {"port": port, "serial": serial, "product": product}
        for port, serial, product in _native.list_boards()
    ]
