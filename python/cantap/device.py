"""The analyser, live."""

from __future__ import annotations

import atexit
import datetime
import numbers
import os
import warnings
import weakref
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any, Literal, SupportsIndex, TypeAlias

from . import _native
from ._arguments import channels as _channels
from ._arguments import rates as _rates
from ._arguments import words as _words
from ._native import CantapWarning, Frame, Odx, PeriodicFrame, Record, Records, Reply, Table
from ._conversations import Paths, Protocol, _bus
from .diagnostics import Ecu, load_odx
from .traces import Databases, Path, Rates, Seconds, Words

Mode: TypeAlias = Literal["listen-only", "normal", "loopback", "silent-loopback"]
AnyFrame: TypeAlias = "Frame | str"
Channel: TypeAlias = "int | str"
"""1, 2, or as an interface: `can0` is channel 1."""
Rate: TypeAlias = "int | str"
"""In bit/s, or `500k`; `auto` finds it by listening."""
Id: TypeAlias = "int | str"
"""`0x123`, or `"123"`: eight digits have 29 bits."""
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
        self._expects = False
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
        channel: Channel,
        bitrate: Rate | None = None,
        *,
        mode: Mode = "listen-only",
        sample_point: float | None = None,
        sjw: int | None = None,
        segments: tuple[int, int, int, int] | None = None,
        one_shot: bool = False,
        manual_recovery: bool = False,
        filter: str | Iterable[str] = (),
    ) -> int | None:
        """Opens a channel, 1 or 2, and returns its bit rate in bit/s, if it is known.

        Without a bit rate, the one saved on the device is used; the virtual device's buses have 500 kbit/s. A virtual CAN interface of Linux,
        a pipe and a socketcand or cannelloni server need none: it is `None` then, and the bus load is unknown. `"auto"` finds it by
        listening, see `autobaud`. A rate is in bit/s, or written as `500k`.
        `sample_point` is in per cent; `segments` is prescaler, segment 1, segment 2 and jump width, instead of a bit rate.
        `filter` as with `cantap.read`: the device drops other frames in hardware as far as it can, and this computer drops the rest.
        """
        if bitrate == "auto":
            bitrate = self.autobaud(channel)
        self._expects = True
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

    def autobaud(self, channel: Channel, *, timeout: Seconds = 10.0) -> int:
        """Finds the bit rate of a channel's bus, in bit/s, without sending anything: one frame is enough. The channel must be closed.

        The rate found before on this channel is tried first. Raises `DeviceError`, with what to check, if there is no traffic for
        `timeout` seconds, or none that a bit rate can be found from.
        """
        return self._native.autobaud(channel, timeout)

    def ecu(
        self,
        channel: Channel,
        request: Id | None = None,
        response: Id | None = None,
        *,
        odx: Odx | Path | Iterable[Path] | None = None,
        to_all: bool = False,
        p2: Seconds = 1.0,
        p2_star: Seconds = 5.0,
        timeout: Seconds = 30.0,
        padding: int | None = 0,
    ) -> Ecu:
        """An ECU to ask, over UDS, KWP2000 or OBD-II. The channel must be open with `mode="normal"`.

        `request`, `response`: the identifiers, 7E0 and 7E8 if none is given; or both in one, as `"7E0:7E8"`, or `"6F1/12:612/F1"` where the first data byte is an address. The response's is 8 more, or of 29 bits (18DAxxyy) the same with both addresses exchanged,
        unless it is given. `odx`: its description, a PDX package, ODX document or CDD (`"car.pdx"`, `"car.pdx:Engine_V2"` for one layer of it): then what it
        has can be asked by name, and its only ECU's identifiers need not be given. `to_all`: requests go to all ECUs at once. `p2`: seconds until an answer begins; `p2_star`: the same after the
        ECU has said that it is pending; `timeout`: for everything. `padding`: the byte that fills frames up; `None` keeps them short.
        """
        described = None if odx is None else load_odx(odx)
        if request is None:
            request = (described and response is None and described._only_pair()) or 0x7E0
        if isinstance(request, str) and ":" in request:
            if response is not None:
                raise ValueError(f"'{request}' is a pair already; leave response out")
            pair = request
        else:
            raw, extended = _native.identifier(request)
            if response is None:
                swapped = raw & ~0xFFFF | (raw & 0xFF) << 8 | raw >> 8 & 0xFF
                response = _id_text(swapped if extended and raw >> 16 == 0x18DA else raw + 8, extended)
            pair = ":".join(_id_text(*_native.identifier(id)) for id in (request, response))
        if described is not None:
            # Whether it has this ECU.
            described.requests(pair)
        return Ecu(self._native, channel, pair, to_all, (p2, p2_star, timeout), padding, described)

    def close_channel(self, channel: Channel) -> None:
        """Closes a channel, after everything it captured has arrived."""
        self._native.close_channel(channel)

    @property
    def channels(self) -> dict[int, dict[str, Any]]:
        """The open channels, each with `bitrate` and `mode`."""
        return self._native.open_channels()

    def recover(self, channel: Channel) -> None:
        """Brings a channel that was opened with `manual_recovery` back from bus-off."""
        self._native.recover(channel)

    # Listening

    def __iter__(self) -> Iterator[Record]:
        """Records as they arrive: frames, errors, states, losses. Ends when the device is closed."""
        self._warn_of_silence()
        return self._records

    def read(self, timeout: Seconds | None = None) -> Record | None:
        """The next record; `None` if there is none within `timeout` seconds, or after the last."""
        self._warn_of_silence()
        return self._records.read(timeout)

    def batch(self, seconds: Seconds | None = None, rows: int = 65_536) -> Table:
        """Records of the next `seconds`, at most `rows`, as a table; without `seconds` it waits until there are so many."""
        self._warn_of_silence()
        return self._records.batch(seconds, rows)

    def batches(self, seconds: Seconds = 0.1, rows: int = 65_536) -> Iterator[Table]:
        """Tables of what arrived in the last `seconds` or so, one after the other, until the device is closed. None is empty."""
        self._warn_of_silence()
        while not self.closed:
            table = self._records.batch(seconds, rows)
            if len(table):
                yield table

    def conversations(
        self,
        seconds: Seconds = 0.1,
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
    ) -> Iterator[Table]:
        """Tables of what the frames of the last `seconds` or so mean, as from `cantap.conversations`, whose arguments these are, one after the
        other, until the device is closed. None is empty.

        Without `protocol`, the first three seconds show which protocols there are; what was said in them comes after that.
        """
        reader = _native.Conversations(_bus(protocol, fields, faults, db, pair, eds, odx, a2l, xcp, ccp, dsdl, subject))
        for batch in self.batches(seconds):
            table = reader.take(batch, True)
            if len(table):
                yield table
        table = reader.finish()
        if len(table):
            yield table

    def _warn_of_silence(self) -> None:
        """Nothing arrives before a channel is open: who waits for it waits for ever."""
        if self._expects or self.closed:
            return
        self._expects = True
        if not self.channels:
            text = "no channel is open, so nothing arrives: give cantap.open a bit rate, or call open_channel"
            warnings.warn(text, CantapWarning, stacklevel=3)

    def records(
        self,
        channel: Channel | None = None,
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
        channel: Channel,
        frames: AnyFrame | Iterable[AnyFrame],
        *,
        timeout: Seconds | None = 1.0,
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

    def abort(self, channel: Channel) -> None:
        """Withdraws what a channel still has to send."""
        self._native.abort(channel)

    def send_periodic(
        self,
        channel: Channel,
        frame: AnyFrame,
        period: Seconds,
        *,
        count: int = 0,
        modifiers: Iterable[Counter | Checksum | RandomByte] = (),
    ) -> PeriodicFrame:
        """Has the device send a frame every `period` (seconds, or `"10ms"`) by its own timer, `count` times or until it is stopped.

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
        channel: Channel,
        id: Id,
        frame: AnyFrame,
        *,
        mask: Id | None = None,
        extended: bool | None = None,
        count: int = 0,
    ) -> Reply:
        """Has the device send a frame whenever it receives one with this identifier, within microseconds, until it is stopped."""
        return self._native.reply(channel, (id, mask, extended), frame, count)

    # Error frames

    def disturb(
        self,
        channel: Channel,
        at: Seconds | None = None,
        *,
        id: Id | None = None,
        nth: int | None = None,
        length: int = 6,
        count: int = 1,
        every: Seconds = 0.1,
        yes_on_a_test_bench: bool = False,
    ) -> list[dict[str, Any]]:
        """Makes error frames on purpose (docs/disturb.md), as `cantap disturb` does: `at` a time from now on, by the device's clock, or onto the frames
        of a periodic identifier. Waits until it is done.

        Only a board whose firmware was built for it can do this, on a channel that is open with `mode="normal"`, and only with
        `yes_on_a_test_bench=True`: it raises the error counters of every node on the bus. `nth`: onto which frame first, counted from now.
        `length`: 1 to 12 bits; six are an error frame anywhere. `count`, `every`: how often, at least 20 ms from one to the next.

        Returns what became of each, as `cantap disturb --json` prints it: `length_us` is 0 if it came to nothing.
        """
        if yes_on_a_test_bench is not True:
            raise ValueError("this destroys frames of whatever is on the bus; confirm with yes_on_a_test_bench=True that nothing depends on it")
        return _native.disturb(self._native, channel, at, id, nth, length, count, every)

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

    def identify(self, seconds: Seconds = 5) -> None:
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


def _id_text(id: int, extended: bool) -> str:
    """As the command reads it: eight digits have 29 bits."""
    return f"{id:08X}" if extended else f"{id:03X}"


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
    bitrate: Rates | None = None,
    *,
    channels: str | SupportsIndex | Iterable[str | SupportsIndex] | None = None,
    mode: Mode = "listen-only",
    filter: str | Iterable[str] = (),
    capacity: int = CAPACITY,
    device_intervals: bool = False,
) -> Device:
    """Begins a session with the device at an address, as for the command's `-d`.

    `/dev/ttyACM0`, `COM5`, `virtual`, `virtual:car`, `unix:`, `tcp://HOST`, `tls://HOST`, `ssh://[USER@]HOST`.

    With `device_intervals`, intervals between times are those that the device's crystal measures; otherwise times follow UTC, and corrections change the
    intervals around them, by up to 100 ppm.

    With a bit rate (`500_000`, `"500k"`), or `"auto"`, the `channels` are opened, or all that the device has. With rates for single channels only,
    `{2: "250k"}` or `"2:250k"`, it is these. Without any, no channel is opened: use `Device.open_channel` for each.

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
            rates = {
                channel if channel is None else _native.channel_number(channel): rate for channel, rate in _rates(bitrate, "bitrate")
            }
            every = list(range(1, device.info["channels"] + 1))
            if channels is not None:
                wanted = _channels(channels, every)
            else:
                # Rates of single channels say which are meant.
                wanted = every if None in rates else sorted(rates)
            for channel in wanted:
                number = _native.channel_number(channel)
                device.open_channel(number, rates.get(number, rates.get(None)), mode=mode, filter=filters)
        except BaseException:
            device.close()
            raise
    return device


def selftest(
    address: str | None = None, *, loop: bool = False, load_time: Seconds = 5.0, restart: bool = False
) -> dict[str, Any]:
    """Tests what a board can show on its own, as `cantap selftest` does, and returns what that prints with `--json`: `passed`, and in `steps`
    the name, the outcome and the figures of each. Without an address it is the board that is connected. It must not be open elsewhere.

    Without `loop` no channel puts a dominant bit on its bus, whatever is connected. With it, both channels send: channel 1 must be wired to
    channel 2, and nothing else to them. `load_time`: how long each saturating load lasts. `restart`: restarts the firmware at the end.
    """
    return _native.selftest(address, loop, load_time, restart)


def boards() -> list[dict[str, str | None]]:
    """The boards connected to this computer: `port`, `serial`, `product`."""
    return [
        {"port": port, "serial": serial, "product": product}
        for port, serial, product in _native.list_boards()
    ]
