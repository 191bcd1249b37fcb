"""Periodic messages that the device cannot send on its own: one thread sends those of a Bus object."""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from collections.abc import Callable, Sequence

import can
from can.broadcastmanager import (
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

LOG = logging.getLogger("can.bcm")
"""python-can's own logger for periodic messages."""

MOST_BEHIND_NS = 1_000_000_000
"""Messages that are due for longer are left out: a computer that slept does not send them all at once."""


class Scheduler:
    """Sends the messages of any number of tasks when they are due, in one thread. It runs while there are any.

    :param send: passes a message on, or raises an exception, which stops the message's task.
    """

    def __init__(self, send: Callable[[can.Message], None], name: str) -> None:
        self._send = send
        self._name = name
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        # When, a number that makes entries comparable, and the task, whose own number shows whether the entry is still valid.
        self._due: list[tuple[int, int, HostCyclicTask]] = []
        self._thread: threading.Thread | None = None

    def add(self, task: HostCyclicTask) -> None:
        """Sends a task's messages from now on."""
        with self._changed:
            self._put(task, time.perf_counter_ns())
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
            self._changed.notify()

    def remove(self, task: HostCyclicTask) -> None:
        """Sends none of a task's messages any more, apart from one that is under way."""
        with self._changed:
            task.number = None
            self._changed.notify()

    def close(self) -> None:
        """Ends all tasks, and returns when nothing is sent any more."""
        with self._changed:
            for _, _, task in self._due:
                task.number = None
            self._due.clear()
            self._changed.notify()
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def _put(self, task: HostCyclicTask, due_ns: int) -> None:
        task.number = next(self._numbers)
        heapq.heappush(self._due, (due_ns, task.number, task))

    def _run(self) -> None:
        while (found := self._next()) is not None:
            due_ns, number, task = found
            try:
                self._send(task.next_message())
            except Exception as error:
                # Other tasks go on.
                LOG.error("periodic message %X stopped: %s", task.arbitration_id, error)
                self.remove(task)
            now_ns = time.perf_counter_ns()
            next_ns = due_ns + task.period_ns
            if now_ns - next_ns > MOST_BEHIND_NS:
                next_ns = now_ns
            with self._changed:
                # Unless it was stopped or restarted meanwhile.
                if task.number == number:
                    self._put(task, next_ns)

    def _next(self) -> tuple[int, int, HostCyclicTask] | None:
        """Waits for the next message to be due; `None` if there are no tasks any more."""
        with self._changed:
            while self._due:
                due_ns, number, task = self._due[0]
                if task.number != number:
                    heapq.heappop(self._due)
                    continue
                left_ns = due_ns - time.perf_counter_ns()
                if left_ns > 0:
                    self._changed.wait(left_ns / 1e9)
                    continue
                heapq.heappop(self._due)
                if task.is_over():
                    task.number = None
                    continue
                return due_ns, number, task
            self._thread = None
            return None


class HostCyclicTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Messages that this computer sends in turn: several, changed by a callback, or more than the device has room for."""

    def __init__(
        self,
        scheduler: Scheduler,
        messages: can.Message | Sequence[can.Message],
        period: float,
        duration: float | None,
        autostart: bool,
        modifier_callback: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        self._scheduler = scheduler
        self._modifier_callback = modifier_callback
        self._turn = 0
        self.number: int | None = None
        """Of its entry in the scheduler; `None` while it is stopped."""
        if autostart:
            self.start()

    def start(self) -> None:
        """Starts or restarts it."""
        self._turn = 0
        self.end_time = time.perf_counter() + self.duration if self.duration else None
        self._scheduler.add(self)

    def stop(self) -> None:
        """Stops it; :meth:`start` restarts it."""
        self._scheduler.remove(self)

    def is_over(self) -> bool:
        """Whether its duration has passed."""
        return self.end_time is not None and time.perf_counter() >= self.end_time

    def next_message(self) -> can.Message:
        """The message whose turn it is."""
        message = self.messages[self._turn % len(self.messages)]
        self._turn += 1
        if self._modifier_callback is not None:
            self._modifier_callback(message)
        return message
