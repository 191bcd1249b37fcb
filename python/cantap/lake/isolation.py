"""Passes work to a separate process, which may hang or die."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, cast

#: How often to try a request whose process dies: if memory was short, it may be available the next time.
ATTEMPTS = 2


class Failed(Exception):
    """There is no answer; the message says why."""


class Process:
    """A process that answers lines of JSON with lines of JSON. It is started on demand, and restarted if it has died."""

    def __init__(self, command: Sequence[str], timeout_s: float) -> None:
        self._command = list(command)
        self._timeout_s = timeout_s
        self._running: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Process:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._end()

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The answer; raises `Failed` if there is none in time, or if the process dies at every attempt."""
        attempt = 1
        while True:
            try:
                return self._ask_once(request)
            except EOFError as ended:
                if attempt == ATTEMPTS:
                    raise Failed(f"the process that read it {ended}, {ATTEMPTS} times") from None
                attempt += 1

    def _ask_once(self, request: Mapping[str, Any]) -> dict[str, Any]:
        process = self._running or self._start()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            raise EOFError(self._how_it_ended()) from None
        answer = b""
        end = time.monotonic() + self._timeout_s
        while not answer.endswith(b"\n"):
            ready, _, _ = select.select([process.stdout], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                self._end()
                raise Failed(f"it was not read within {self._timeout_s:g} s")
            piece = os.read(process.stdout.fileno(), 1 << 16)
            if not piece:
                raise EOFError(self._how_it_ended())
            answer += piece
        return cast("dict[str, Any]", json.loads(answer))

    def _start(self) -> subprocess.Popen[bytes]:
        # Modules that Spark has shipped to this machine are found there as well.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._running = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
        )
        return self._running

    def _how_it_ended(self) -> str:
        process, self._running = self._running, None
        assert process is not None
        code = process.wait()
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def _end(self) -> None:
        process, self._running = self._running, None
        if process is not None:
            process.kill()
            process.communicate()
