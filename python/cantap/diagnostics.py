"""Asking ECUs: UDS, KWP2000 and OBD-II, over an open device."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ._native import CantapWarning, DeviceError, Odx, ask_ecu, refusal_text

if TYPE_CHECKING:
    from . import _native
    from .traces import Path, Seconds

Bytes = bytes | bytearray | str | Iterable[int]

READ_DATA = 0x22
SESSION = 0x10
OBD_VEHICLE = 0x09
OBD_CURRENT = 0x01
OBD_CODES = {"stored": 0x03, "pending": 0x07, "permanent": 0x0A}


class NegativeResponse(DeviceError):
    """An ECU refused a request."""

    def __init__(self, service: int, code: int) -> None:
        name, reason = refusal_text(service, code)
        super().__init__(f"the ECU refused {name}: {reason} ({code:02X})")
        self.service = service
        """The service that was asked for."""
        self.code = code
        """The reason's number (NRC)."""

    def __reduce__(self) -> tuple[type[NegativeResponse], tuple[int, int]]:
        return (NegativeResponse, (self.service, self.code))


def load_odx(files: Odx | Path | Iterable[Path]) -> Odx:
    """Reads descriptions of ECUs: PDX packages, ODX documents and CDDs, each with a layer behind it (`car.pdx:Engine_V2`) if one is meant.

    What of a usable file is not evaluated is in `Odx.warnings`, and causes a `CantapWarning`.
    """
    if isinstance(files, Odx):
        return files
    odx = Odx([files] if isinstance(files, (str, os.PathLike)) else list(files))
    for text in odx.warnings:
        warnings.warn(text, CantapWarning, stacklevel=2)
    return odx


class Ecu:
    """An ECU on a channel that was opened with `mode="normal"`; made by `Device.ecu`.

    Long messages are segmented as ISO 15765-2 says. Everything else that uses the device goes on meanwhile.
    """

    def __init__(
        self,
        device: _native.Device,
        channel: int | str,
        pair: str,
        is_to_all: bool,
        times: tuple[Seconds, Seconds, Seconds],
        padding: int | None,
        odx: Odx | None = None,
    ) -> None:
        self._device = device
        self._channel = channel
        self._pair = pair
        self._is_to_all = is_to_all
        self._times = times
        self._padding = padding
        self._odx = odx

    def request(self, data: Bytes) -> bytes:
        """Sends a request, such as `"22 F190"` or `b"\\x3e\\x00"`, and returns the answer, its first byte included.

        Raises `NegativeResponse` if the ECU refuses, and `DeviceError` if it does not answer. Empty if the request wants no answer.
        """
        answers = self._ask(data, self._is_to_all)
        if not answers:
            return b""
        _, answer = answers[0]
        if answer[:1] == b"\x7f" and len(answer) >= 3:
            raise NegativeResponse(answer[1], answer[2])
        return answer

    def request_all(self, data: Bytes) -> dict[str, bytes]:
        """Asks all ECUs at once (7DF), and returns their answers by their identifiers; refusals, which begin with 7F, too."""
        return dict(self._ask(data, True))

    def read_data(self, identifier: int | str) -> bytes:
        """The value of a data identifier (UDS service 22), such as `0xF190` or `"F190"`, the VIN, or by its name in the ECU's description (ODX)."""
        if isinstance(identifier, str):
            if not re.fullmatch("(0[xX])?[0-9A-Fa-f]{1,4}", identifier):
                return self._after(self._named(identifier, bytes([READ_DATA])))
            identifier = int(identifier, 16)
        if not 0 <= identifier <= 0xFFFF:
            raise ValueError(f"{identifier:#x} is not a data identifier; they go from 0 to 0xFFFF")
        return self._after(bytes([READ_DATA]) + identifier.to_bytes(2, "big"))

    def ask(self, name: str) -> dict[str, Any]:
        """Sends a request by its name in the ECU's description (ODX), of data (22), a routine (31) or any other, and returns the values of the answer by
        their names: numbers, texts, bytes. What of the answer has no value causes a `CantapWarning`."""
        request = self._named(name, b"")
        answer = self.request(request)
        assert self._odx is not None
        values, missing = self._odx._values(self._pair, request, answer)
        if missing is not None:
            warnings.warn(f"{name}: {missing} has no value: {answer.hex(' ').upper()}", CantapWarning, stacklevel=2)
        return values

    def _named(self, name: str, begins: bytes) -> bytes:
        if self._odx is None:
            raise ValueError(f"'{name}' is a name of the ECU's description; give it with odx= to Device.ecu, or give a number, such as 0xF190")
        return self._odx._request(self._pair, name, begins)

    def session(self, kind: int) -> None:
        """Opens a diagnostic session (UDS service 10): 1 is the default one, 3 the extended one. It ends on its own after 5 s without
        a request, unless `request("3E 80")` keeps it."""
        self.request(bytes([SESSION, kind]))

    def obd(self, parameter: int) -> bytes:
        """The current value of a parameter of OBD-II (service 01), such as 0x0C for the engine's speed."""
        return self._after(bytes([OBD_CURRENT, parameter]))

    def vin(self) -> str:
        """The vehicle's identification number, over OBD-II (service 09)."""
        # A byte with the number of items comes first.
        return self._after(bytes([OBD_VEHICLE, 0x02]))[1:].strip(b"\0").decode("ascii", "replace")

    def trouble_codes(self, kind: str = "stored") -> list[str]:
        """The trouble codes of OBD-II, `stored`, `pending` or `permanent`, such as `P0133`."""
        if kind not in OBD_CODES:
            raise ValueError(f"'{kind}' is not a kind of trouble codes; there are {', '.join(OBD_CODES)}")
        # On CAN, their number comes first (SAE J1979).
        codes = self.request(bytes([OBD_CODES[kind]]))[2:]
        pairs = [codes[at : at + 2] for at in range(0, len(codes) - 1, 2)]
        return ["PCBU"[high >> 6] + f"{high >> 4 & 3}{high & 15:X}{low:02X}" for high, low in pairs if (high, low) != (0, 0)]

    def _ask(self, data: Bytes, is_to_all: bool) -> list[tuple[str, bytes]]:
        request = bytes.fromhex(data) if isinstance(data, str) else bytes(data)
        return ask_ecu(self._device, self._channel, self._pair, is_to_all, request, self._times, self._padding)

    def _after(self, request: bytes) -> bytes:
        """An answer without what it repeats of the request."""
        answer = self.request(request)
        if answer[1 : len(request)] != request[1:]:
            raise DeviceError(f"the answer {answer.hex(' ').upper()} is not to {request.hex(' ').upper()}")
        return answer[len(request) :]

    def __repr__(self) -> str:
        return f"<cantap.Ecu {self._pair} on channel {self._channel}>"
