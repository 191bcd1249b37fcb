"""Lets python-can's own tests run on the analyser: a pytest plugin that replaces python-can's virtual interface with it.

Those tests open two buses with the same name, which see each other: here they are the two channels of a virtual device on one bus, or, with
`CANTAP_ON` set to `one channel`, Bus objects of the same channel. A third one is on the first channel. Each name is a device. The tests use details of python-can's virtual interface and its threads, which are added here and are not part of the
plugin: the number of waiting messages (`queue`), and the thread of a periodic task (`thread`).
"""

import collections
import os
import threading

import can
from cantap.can_bus import CantapBus, DeviceCyclicTask

_in_use = collections.defaultdict(list)
_lock = threading.Lock()
CHANNELS = [1] if os.environ.get("CANTAP_ON") == "one channel" else [1, 2]


class Queue:
    """The part of a message queue that these tests use."""

    def __init__(self, bus):
        self._bus = bus

    def qsize(self):
        """The number of waiting messages."""
        while (message := self._bus._take(0)) is not None:
            self._bus.waiting.append(message)
        return len(self._bus.waiting)

    def empty(self):
        """Whether no message is waiting."""
        return self.qsize() == 0


class Bus(CantapBus):
    """Opened like python-can's virtual interface."""

    def __init__(self, channel=None, bitrate=500_000, receive_own_messages=False, **kwargs):
        self.name = channel
        self.waiting = collections.deque()
        self.queue = Queue(self)
        with _lock:
            free = [number for number in CHANNELS if number not in _in_use[channel]]
            self.taken = next(iter(free), 1)
            _in_use[channel].append(self.taken)
        serial = "".join(letter for letter in str(channel) if letter.isalnum())
        # Set this before anything can fail.
        self._periodic_tasks = []
        for option in ("fd", "single_handle", "preserve_timestamps", "rx_queue_size", "interface"):
            kwargs.pop(option, None)
        super().__init__(
            f"virtual:load=0,wire=joined,serial={serial or 'none'}:{self.taken}",
            bitrate=bitrate,
            receive_own_messages=receive_own_messages,
            **kwargs,
        )

    def _take(self, timeout):
        message, _ = super()._recv_internal(timeout)
        if message is not None:
            message.channel = self.name
        return message

    def _recv_internal(self, timeout):
        if self.waiting:
            return self.waiting.popleft(), True
        return self._take(timeout), True

    def shutdown(self):
        if not self._is_shutdown:
            super().shutdown()
            with _lock:
                _in_use[self.name].remove(self.taken)


can.interfaces.BACKENDS["virtual"] = (__name__, "Bus")
# The analyser does not support CAN FD.
DeviceCyclicTask.thread = threading.Thread(target=lambda: None)
DeviceCyclicTask.thread.start()


def pytest_collection_modifyitems(config, items):
    """The analyser does not support CAN FD."""
    kept = [item for item in items if "_fd" not in item.name]
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept
