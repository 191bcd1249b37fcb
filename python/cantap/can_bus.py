"""The interface `cantap` of python-can: `can.Bus(interface="cantap", channel="/dev/ttyACM0:1", bitrate=500_000)`."""

from __future__ import annotations

import collections
import contextlib
import inspect
import itertools
import logging
import math
import os
import threading
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import can
from can.broadcastmanager import (
    CyclicSendTaskABC,
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from . import _native
from ._native import CantapWarning, DeviceError, PeriodicFrame
from ._periodic import HostCyclicTask, Scheduler
from .device import CAPACITY, Device, Mode, boards

LOG = logging.getLogger("can.bus")
"""python-can's own logger for received messages."""

ALL_ERRORS = "#1FFFFFFF"
EXTENDED = 0x8000_0000
OF_OTHERS = {"fd", "data_bitrate", "interface", "ignore_config", "config_context", "single_handle"}
"""Arguments that python-can's own programs pass to every interface."""
HAS_AUTOSTART = "autostart" in inspect.signature(can.BusABC._send_periodic_internal).parameters
"""Whether python-can can make a periodic task without starting it: since 4.5."""
QUEUE_TIMEOUT = 10.0
"""How long a frame waits for room in the device's queue, in seconds, if no other time is given."""


class _Session:
    """A device that the Bus objects of its channels share."""

    def __init__(self, address: str) -> None:
        self.device = Device(address, capacity=0)
        self.users: dict[int, dict[int, Any]] = {}
        """For each channel, its Bus objects by their numbers, and what each of them wants to receive."""
        self.passed: dict[int, Any] = {}
        """What each open channel's hardware passes."""

    def is_gone(self) -> bool:
        """Whether the device was closed, or has vanished: then a new Bus object needs a new session, although others may still have this one."""
        try:
            return self.device.closed or not self.device.status
        except DeviceError:
            return True

    def wanted(self, channel: int) -> Any:
        """Filters that pass whatever any of a channel's Bus objects wants; `None` for everything."""
        wanted = self.users[channel].values()
        return [one for filters in wanted for one in filters] if all(wanted) else None

    def open(self, channel: int, mode: Mode, options: dict[str, Any]) -> None:
        """Opens a channel. A node of the bus receives everything, since it could not leave the bus whenever a program changes a filter: only
        where the device merely listens does its hardware filter."""
        passed = self.wanted(channel) if mode == "listen-only" else None
        filters = _filter_texts(passed)
        self.device._native.open_channel(channel, {**options, "mode": mode, "filters": filters})
        self.passed[channel] = passed

    def widen(self, channel: int) -> None:
        """Opens a channel anew if its hardware drops what a Bus object wants. What is missed meanwhile is a loss in everyone's stream."""
        wanted, passed = self.wanted(channel), self.passed.get(channel)
        if passed and not (wanted and all(any(_covers(wide, one) for wide in passed) for one in wanted)):
            self.device._native.reopen(channel, _filter_texts(wanted))
            self.passed[channel] = wanted


_sessions: dict[str, _Session] = {}
_numbers = itertools.count(1)
"""Of Bus objects: by these the records of their frames are told apart."""
_lock = threading.RLock()


def _forget_sessions() -> None:
    """In a forked process they are still the other one's: here each device is opened anew."""
    global _lock
    _sessions.clear()
    # Another thread may have held it in that instant.
    _lock = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_sessions)


@contextlib.contextmanager
def _as_can_errors() -> Iterator[None]:
    """Errors of the device as those of python-can."""
    try:
        yield
    except DeviceError as error:
        raise can.CanOperationError(str(error)) from error


def _split(channel: str) -> tuple[str, int]:
    """`/dev/ttyACM0:2` is channel 2 of that device; without a number it is channel 1."""
    address, colon, number = channel.rpartition(":")
    if colon and number in ("1", "2"):
        return address, int(number)
    return channel, 1


def _flag(argument: str, value: Any) -> bool:
    """A yes or no; in a configuration file it is a word, of which python-can itself knows only true and false."""
    known = {"yes": True, "on": True, "true": True, "1": True, "no": False, "off": False, "false": False, "0": False}
    found = known.get(str(value).lower())
    if found is None:
        raise can.CanInitializationError(f"{argument} is true or false, not {value!r}")
    return found


def _bit_rate(rate: Any) -> int:
    try:
        return _native.bit_rate(rate)
    except ValueError as error:
        raise can.CanInitializationError(f"bitrate: {error}") from None


class CantapBus(can.BusABC):
    """A channel of a cantap analyser. Two channels of one analyser are two Bus objects that share its session.

    :param channel: the device's address and the channel's number: `/dev/ttyACM0:1`, `virtual:2`, `tcp://bench:1`.
    :param bitrate: in bit/s, or as `500k`, or `auto`, which finds it by listening; without it, the one saved on the device. `timing` may be given instead.
    :param receive_own_messages: also receive messages that this device sends on this channel.
    :param listen_only: send nothing and acknowledge nothing. Also with `state=can.BusState.PASSIVE`.
    :param one_shot: send each frame once.
    :param manual_recovery: stay bus-off until :meth:`recover`.
    :param rx_capacity: how many messages may wait; others are lost and counted, and an error frame says so.

    Times are the device's stamps. Bus errors, state changes and losses are error frames as in SocketCAN.
    """

    def __init__(
        self,
        channel: str,
        can_filters: Any = None,
        *,
        bitrate: int | str | None = None,
        timing: can.BitTiming | can.BitTimingFd | None = None,
        receive_own_messages: bool = False,
        listen_only: bool = False,
        state: can.BusState = can.BusState.ACTIVE,
        one_shot: bool = False,
        manual_recovery: bool = False,
        rx_capacity: int = CAPACITY,
        **kwargs: Any,
    ) -> None:
        if isinstance(timing, can.BitTimingFd):
            raise can.CanInitializationError("the data bit rate belongs into the address, as in gs_usb:?data-bitrate=2M; give a can.BitTiming")
        if timing is not None and not isinstance(timing, can.BitTiming):
            raise TypeError(f"timing is a can.BitTiming, not {type(timing).__name__}")
        if state is can.BusState.ERROR:
            raise can.CanInitializationError("a bus does not begin in the state ERROR; choose ACTIVE or PASSIVE")
        # A configuration file may have more for other interfaces. But a slip in `listen_only` must not remain unseen.
        for unknown in sorted(kwargs.keys() - OF_OTHERS):
            warnings.warn(f"the interface cantap has no argument {unknown}; it does nothing", CantapWarning, stacklevel=3)
        self._address, self._number = _split(str(channel))
        self._own = _flag("receive_own_messages", receive_own_messages)
        self._options: dict[str, Any] = {
            "bitrate": bitrate if bitrate in (None, "auto") else _bit_rate(bitrate),
            "sample_point": None,
            "sjw": None,
            "segments": None,
            "one_shot": _flag("one_shot", one_shot),
            "manual_recovery": _flag("manual_recovery", manual_recovery),
        }
        self._me = next(_numbers)
        is_quiet = _flag("listen_only", listen_only) or state is can.BusState.PASSIVE
        mode: Mode = "listen-only" if is_quiet else "normal"
        self.channel_info = f"cantap {self._address} channel {self._number}"
        self._can_protocol = can.CanProtocol.CAN_20
        with _lock:
            session = _sessions.get(self._address)
            try:
                if session is None or session.is_gone():
                    session = _Session(self._address)
                self._device = session.device
                if self._device.info["transmits_fd"]:
                    self._can_protocol = can.CanProtocol.CAN_FD
                elif kwargs.get("fd"):
                    raise can.CanInitializationError(
                        "this device sends no CAN FD frames; open the channel without fd, or give an adapter its data bit rate"
                    )
                self._options["segments"] = self._segments(timing)
                # Before the first frame can arrive. Messages of other Bus objects come as if from another node.
                self._records = self._device._native.records(
                    self._number, _filter_texts(can_filters), not self._own, rx_capacity, self._me
                )
                users = session.users.setdefault(self._number, {})
                is_first = not users
                users[self._me] = can_filters or None
                try:
                    if is_first:
                        if self._options["bitrate"] == "auto":
                            self._options["bitrate"] = self._device.autobaud(self._number)
                        session.open(self._number, mode, self._options)
                    else:
                        self._join(mode)
                        session.widen(self._number)
                except BaseException:
                    self._leave(session)
                    raise
            except BaseException as error:
                if session is not None and not session.users:
                    session.device.close()
                if isinstance(error, (DeviceError, ValueError)):
                    raise can.CanInitializationError(str(error)) from error
                raise
            _sessions[self._address] = session
        self._session = session
        # What came from the device in one call.
        self._waiting: collections.deque[can.Message] = collections.deque()
        # As of the last call: asking for each message would take as long as everything else here.
        self._is_logged = False
        self._is_over = False
        self._scheduler = Scheduler(self._send_due, f"cantap {self._address}:{self._number}")
        self._is_extended = type(self)._recv_internal is not CantapBus._recv_internal
        super().__init__(channel=channel, can_filters=can_filters)

    def _segments(self, timing: can.BitTiming | None) -> tuple[int, int, int, int] | None:
        if timing is None:
            return None
        clock = self._device.info["can_clock_hz"]
        if timing.f_clock != clock:
            timing = timing.recreate_with_f_clock(clock)
        return timing.brp, timing.tseg1, timing.tseg2, timing.sjw

    def _leave(self, session: _Session) -> bool:
        """Returns whether another Bus object has the channel open."""
        users = session.users[self._number]
        users.pop(self._me, None)
        if not users:
            del session.users[self._number]
            session.passed.pop(self._number, None)
        return bool(users)

    def _join(self, mode: Mode) -> None:
        """Another Bus object has the channel open: its settings stay as they are."""
        now = self._device.channels[self._number]
        wanted = self._options["bitrate"]
        if wanted not in (None, "auto", now["bitrate"]) or now["mode"] != mode:
            raise can.CanInitializationError(
                f"{self.channel_info} is open at {now['bitrate']} bit/s, {now['mode']}; open it as it is"
            )

    @property
    def device(self) -> Device:
        """The device, for what python-can does not support: its clock, replies, timed sending."""
        return self._device

    # Receiving

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Like python-can's, without its loop: filters have already been applied."""
        if self._is_extended:
            return super().recv(timeout)
        message = self._next(timeout)
        if self._is_logged and message is not None:
            LOG.log(self.RECV_LOGGING_LEVEL, "Received: %s", message)
        return message

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self._next(timeout), True

    def _next(self, timeout: float | None) -> can.Message | None:
        waiting = self._waiting
        while True:
            try:
                message = waiting.popleft()
            except IndexError:
                pass
            else:
                if not waiting:
                    self._records._used_up()
                return message
            # Not within `except`: an error would seem to have come of the empty queue.
            if not self._fetch(timeout):
                return None

    def _fetch(self, timeout: float | None) -> bool:
        """Makes messages of what the device has received; false if there is nothing within the time."""
        self._expect_open()
        with _as_can_errors():
            more = self._records._messages(timeout)
        self._is_logged = LOG.isEnabledFor(self.RECV_LOGGING_LEVEL)
        # In place: another thread may have added some at the same time.
        self._waiting.extend(itertools.starmap(can.Message, more))
        return bool(more)

    def _expect_open(self) -> None:
        """The device may still be open for other Bus objects."""
        if self._is_over:
            raise can.CanOperationError(f"{self.channel_info} is shut down")

    def _apply_filters(self, filters: Any) -> None:
        with _lock, _as_can_errors():
            users = self._session.users.get(self._number, {})
            # In another process, after a fork, and after the end it is not one of them.
            if self._me in users:
                users[self._me] = filters
                self._session.widen(self._number)
            self._records._filter(_filter_texts(filters))
            # As in python-can's own interface, what is waiting must pass as well.
            for _ in range(len(self._waiting)):
                with contextlib.suppress(IndexError):
                    message = self._waiting.popleft()
                    if message.is_error_frame or self._matches_filters(message):
                        self._waiting.append(message)
            if not self._waiting:
                self._records._used_up()

    def losses(self) -> dict[str, int]:
        """Frames of this channel that were received and lost since the session began, by stage; `bus` is this object.

        Where frames are missing, :meth:`recv` returns an error frame with the class "controller problem" and the detail "RX buffer overflow",
        whose bytes 2 to 5 contain their number.
        """
        self._expect_open()
        with _as_can_errors():
            counts = dict(self._device.losses[self._number])
            counts["bus"] = self._records.lost[self._number - 1]
        counts["lost"] += counts["bus"]
        return counts

    def fileno(self) -> int:
        """A file descriptor that is readable while a message is waiting: for `asyncio` and `select`."""
        with _as_can_errors():
            return self._records.fileno()

    # Sending

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Passes a message to the device; with `timeout` (seconds), waits until it was on the bus."""
        self._expect_open()
        frame = _frame(msg)
        wait = timeout if timeout is not None and timeout > 0 else None
        with _as_can_errors():
            self._device._native.send(self._number, [frame], wait, None, QUEUE_TIMEOUT, self._me)

    def _send_due(self, msg: can.Message) -> None:
        """Sends a periodic message. It is left out while the device's queue is full: its next one comes anyway, and others are waiting."""
        self._expect_open()
        if type(self).send is not CantapBus.send:
            self.send(msg)
            return
        frame = _frame(msg)
        with _as_can_errors():
            self._device._native.send_now(self._number, frame, self._me)

    def flush_tx_buffer(self) -> None:
        """Withdraws what has not been sent yet."""
        self._expect_open()
        with _as_can_errors():
            self._device.abort(self._number)

    def _send_periodic_internal(
        self,
        msgs: can.Message | Sequence[can.Message],
        period: float,
        duration: float | None = None,
        *others: Any,
        **named: Any,
    ) -> CyclicSendTaskABC:
        self._expect_open()
        # Before python-can 4.5 there was only the callback; since then `autostart` is in front of it.
        names = ("autostart", "modifier_callback") if HAS_AUTOSTART else ("modifier_callback",)
        options = {**dict(zip(names, others)), **named}
        autostart = options.get("autostart", True)
        modifier_callback = options.get("modifier_callback")
        # It would be sent without a pause.
        if not 0 < period < math.inf:
            raise ValueError(f"a period of {period} s is impossible")
        messages = CyclicSendTaskABC._check_and_convert_messages(msgs)
        if len(messages) == 1 and modifier_callback is None:
            try:
                return DeviceCyclicTask(self, messages, period, duration, autostart)
            except (ValueError, DeviceError):
                pass  # The device cannot do this, or has no room for it: this computer does it.
        return HostCyclicTask(self._scheduler, messages, period, duration, autostart, modifier_callback)

    # State

    @property
    def state(self) -> can.BusState:
        """ERROR: bus-off. PASSIVE: it only listens, or is error passive. ACTIVE otherwise."""
        self._expect_open()
        with _as_can_errors():
            channel = self._device.status["channels"][self._number - 1]
        if channel["state"] == "bus-off":
            return can.BusState.ERROR
        if channel["mode"] == "listen-only" or channel["state"] == "passive":
            return can.BusState.PASSIVE
        return can.BusState.ACTIVE

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is can.BusState.ERROR:
            raise ValueError("a bus is not put into the state ERROR; choose ACTIVE or PASSIVE")
        self._expect_open()
        mode: Mode = "listen-only" if new_state is can.BusState.PASSIVE else "normal"
        with _lock, _as_can_errors():
            self._device.close_channel(self._number)
            self._session.open(self._number, mode, self._options)

    def recover(self) -> None:
        """Comes back from bus-off if recovery is manual."""
        self._expect_open()
        with _as_can_errors():
            self._device.recover(self._number)

    def shutdown(self) -> None:
        """Stops periodic messages, and closes the channel if no other Bus object uses it."""
        if self._is_shutdown:
            return
        super().shutdown()
        # Before the channel is closed: nothing may be under way.
        self._scheduler.close()
        self._is_over = True
        with _lock:
            session = self._session
            is_used = self._leave(session)
            self._records.close()
            self._waiting.clear()
            try:
                if not session.users:
                    session.device.close()
                elif not is_used:
                    session.device.close_channel(self._number)
            except DeviceError as error:
                raise can.CanOperationError(str(error)) from error
            finally:
                if not session.users and _sessions.get(self._address) is session:
                    del _sessions[self._address]

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        return [
            {"interface": "cantap", "channel": f"{board['port']}:{number}"}
            for board in boards()
            for number in (1, 2)
        ]


class DeviceCyclicTask(
    LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC
):
    """A message that the device sends by its own timer."""

    def __init__(
        self,
        bus: CantapBus,
        messages: Sequence[can.Message],
        period: float,
        duration: float | None,
        autostart: bool,
    ) -> None:
        super().__init__(messages, period, duration)
        self._bus = bus
        self._task: PeriodicFrame | None = None
        _frame(self.messages[0])
        if autostart:
            self.start()

    def start(self) -> None:
        """Starts or restarts it."""
        # Not `stop`, which the bus has wrapped so as to forget the task.
        self._end()
        count = 0 if self.duration is None else max(1, math.ceil(self.duration / self.period))
        self._task = self._bus.device._native.periodic(
            self._bus._number, _frame(self.messages[0]), self.period, count, [], self._bus._me
        )

    def stop(self) -> None:
        """Stops it; :meth:`start` restarts it."""
        self._end()

    def _end(self) -> None:
        if self._task is not None:
            self._task.stop()
            self._task = None

    def modify_data(self, messages: can.Message | Sequence[can.Message]) -> None:
        """Sends other data from now on."""
        super().modify_data(messages)
        if self._task is not None:
            self._task.update(_frame(self.messages[0]))


def _frame(msg: can.Message) -> _native.Frame:
    if msg.is_error_frame:
        raise can.CanOperationError("an error frame cannot be sent")
    try:
        if msg.is_fd:
            return _native.Frame(
                msg.arbitration_id,
                bytes(msg.data),
                extended=msg.is_extended_id,
                remote=msg.is_remote_frame,
                fd=True,
                brs=msg.bitrate_switch,
                esi=msg.error_state_indicator,
            )
        if msg.is_remote_frame:
            return _native.Frame(msg.arbitration_id, extended=msg.is_extended_id, remote=True, dlc=msg.dlc)
        return _native.Frame(msg.arbitration_id, bytes(msg.data), extended=msg.is_extended_id)
    except (ValueError, OverflowError) as error:
        raise can.CanOperationError(str(error)) from error


def _covers(wide: Any, narrow: Any) -> bool:
    """Whether one of python-can's filters passes everything that the other one passes."""
    mask = wide["can_mask"]
    is_same_kind = wide.get("extended") in (None, narrow.get("extended"))
    return is_same_kind and mask & ~narrow["can_mask"] == 0 and (wide["can_id"] ^ narrow["can_id"]) & mask == 0


def _filter_texts(filters: Any) -> list[str]:
    """python-can's filters in candump's syntax. Error frames pass, as with SocketCAN."""
    if not filters:
        return []
    elements = []
    for one in filters:
        identifier, mask = one["can_id"] & 0x1FFF_FFFF, one["can_mask"] & 0x1FFF_FFFF
        extended = one.get("extended")
        flag = 0 if extended is None else EXTENDED
        if extended or (extended is None and identifier > 0x7FF):
            elements.append(f"{identifier:08X}:{mask | flag:X}")
        elif identifier & mask <= 0x7FF:
            elements.append(f"{identifier & 0x7FF:03X}:{mask | flag:X}")
        # No standard identifier is that large.
    # If nothing is wanted: no frame matches both.
    none = [] if elements else ["000:0", "000~0", "j"]
    return [",".join(["any", *elements, *none, ALL_ERRORS])]
