"""Divides one large trace into parts that are decoded independently of each other.

BLF and candump's logs are divided here, without anybody reading all of them; what has another format, by times that one reading of the whole trace
finds (`cantap_formats::divide`), whose index then leads each worker straight to its part.

BLF: between two objects of its containers, the second of which is a frame. candump's logs: between two lines. A part is a list of pieces: ranges of
the file, and bytes that are in none, such as BLF's head. Whether a part was divided rightly shows when it is read: it ends with its last object or
line, and nothing in it is wrong. Otherwise the trace is read as one.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from .ledger import EMPTY, READ, UNDECODED, Entry

#: A range of the file, or bytes in base64: both are JSON.
Piece = tuple[int, int] | str

_HEAD_BYTES = 144
_BASE = struct.Struct("<4sHHII")
_CONTAINER = struct.Struct("<HH4xII")
_CONTAINER_HEAD_BYTES = _BASE.size + 16
_LOG_CONTAINER = 10
#: Frames: what precedes them cannot change what they mean.
_FRAMES = (1, 86, 100, 101)
_MOST_OBJECT_BYTES = 4096
#: Programs write 128 KiB.
_MOST_UNPACKED_BYTES = 16 << 20
#: A line of a log is far shorter.
_MOST_LINE_BYTES = 1 << 16


@dataclass(frozen=True)
class Divided:
    """A trace's format, and its parts."""

    format: str
    parts: list[list[Piece]]


def divide(path: Path, part_bytes: int) -> Divided | None:
    """The parts of a trace, or `None` if it is not to be divided: too short, in another format, or not as this knows it."""
    try:
        return _divide(path, part_bytes)
    except (OSError, struct.error):
        # Whoever reads it says what is wrong.
        return None


def _divide(path: Path, part_bytes: int) -> Divided | None:
    size = path.stat().st_size
    if size < 2 * part_bytes:
        return None
    with open(path, "rb") as file:
        head = file.read(_HEAD_BYTES)
        if head.startswith(b"LOGG") and path.suffix.lower() == ".blf":
            parts = _of_blf(file, head, size, part_bytes)
            return Divided("blf", parts) if parts else None
        if head.startswith(b"(") and path.suffix.lower() == ".log":
            parts = _of_lines(file, size, part_bytes)
            return Divided("candump", parts) if parts else None
    return None


def _of_lines(file: BinaryIO, size: int, part_bytes: int) -> list[list[Piece]] | None:
    file.seek(size - 1)
    if file.read(1) != b"\n":
        return None
    places = [0]
    for place in range(part_bytes, size - part_bytes // 2, part_bytes):
        file.seek(place)
        end = file.read(_MOST_LINE_BYTES).find(b"\n")
        if end < 0:
            return None
        places.append(place + end + 1)
    return [[(start, end - start)] for start, end in zip(places, [*places[1:], size], strict=True)]


def _of_blf(file: BinaryIO, head: bytes, size: int, part_bytes: int) -> list[list[Piece]] | None:
    length, file_bytes = struct.unpack_from("<4xI8xQ", head)
    if not _HEAD_BYTES <= length <= 4096 or size < file_bytes:
        return None
    file.seek(0)
    # A part is not as long as the file's head says.
    first = file.read(length)
    first = first[:16] + bytes(8) + first[24:]
    containers = _containers(file, length, size)
    if containers is None:
        return None
    parts: list[list[Piece]] = []
    pieces: list[Piece] = [_inline(first)]
    begin, begins_inside = length, False
    for at, bytes_there, behind_it in containers:
        if at - begin >= part_bytes and size - at >= part_bytes // 2:
            # Where no frame is found, it may be in the next one.
            if (cut := _cut(file, at, bytes_there)) is not None:
                before, behind = cut
                pieces += [(begin, at - begin), _inline(before)]
                parts.append(pieces)
                pieces = [_inline(first), _inline(behind)]
                begin, begins_inside = behind_it, True
    if not begins_inside:
        return None
    parts.append([*pieces, (begin, size - begin)])
    return parts


def _containers(file: BinaryIO, at: int, size: int) -> list[tuple[int, int, int]] | None:
    """Where the containers are, their lengths, and where the next ones are; `None` if anything else is between them."""
    found = []
    file.seek(at)
    base = file.read(_BASE.size)
    while base:
        if len(base) < _BASE.size:
            return None
        signature, _, _, length, kind = _BASE.unpack(base)
        if signature != b"LOBJ" or kind != _LOG_CONTAINER or length < _CONTAINER_HEAD_BYTES or at + length > size:
            return None
        file.seek(at + length)
        behind = file.read(_BASE.size + 3)
        padding = len(behind[:3]) - len(behind[:3].lstrip(b"\0"))
        found.append((at, length, at + length + padding))
        at += length + padding
        base = behind[padding : padding + _BASE.size]
    return found


def _cut(file: BinaryIO, at: int, length: int) -> tuple[bytes, bytes] | None:
    """A container in two: before its first frame's object, and from there on."""
    file.seek(at)
    container = file.read(length)
    method, _, unpacked, _ = _CONTAINER.unpack_from(container, _BASE.size)
    data = container[_CONTAINER_HEAD_BYTES:]
    if method == 2:
        unpacker = zlib.decompressobj()
        try:
            data = unpacker.decompress(data, _MOST_UNPACKED_BYTES)
        except zlib.error:
            return None
        if not unpacker.eof or len(data) != unpacked:
            return None
    elif method != 0:
        return None
    place = data.find(b"LOBJ")
    while place >= 0:
        if _is_frame(data, place):
            return _plain(data[:place]), _plain(data[place:])
        place = data.find(b"LOBJ", place + 1)
    return None


def _is_frame(data: bytes, place: int) -> bool:
    """Whether a frame's object begins here, and another object behind it: data may contain the signature by chance."""
    if place + _BASE.size > len(data):
        return False
    _, head, version, length, kind = _BASE.unpack_from(data, place)
    if kind not in _FRAMES or version not in (1, 2) or not _BASE.size <= head <= length <= _MOST_OBJECT_BYTES:
        return False
    behind = place + length
    return any(data.startswith(b"LOBJ", behind + padding) for padding in range(4))


def _plain(objects: bytes) -> bytes:
    """A container of objects that are not compressed."""
    length = _CONTAINER_HEAD_BYTES + len(objects)
    container = _BASE.pack(b"LOBJ", _BASE.size, 1, length, _LOG_CONTAINER) + _CONTAINER.pack(0, 0, len(objects), 0) + objects
    # As Vector's programs do, by the rest and not up to a multiple.
    return container + bytes(length % 4)


def _inline(content: bytes) -> str:
    return base64.b64encode(content).decode()


class Pieces:
    """A part as a file that can be read."""

    def __init__(self, path: str, pieces: Sequence[Any], name: str, format: str) -> None:
        self.name = name
        self._format = format
        self._file = open(path, "rb")
        self._pieces = [base64.b64decode(piece) if isinstance(piece, str) else tuple(piece) for piece in pieces]
        #: Lines, and those of interfaces that have the same channel in each part.
        self._lines = self._plain_lines = 0
        self._rest = b""

    def read(self, size: int) -> bytes:
        """At most so many bytes; none at the end."""
        found = self._read(size)
        if self._format == "candump":
            self._count(found)
        return found

    def _read(self, size: int) -> bytes:
        while self._pieces:
            piece = self._pieces[0]
            if isinstance(piece, bytes):
                found, rest = piece[:size], piece[size:]
                self._pieces[:1] = [rest] if rest else []
            else:
                start, length = piece
                self._file.seek(start)
                found = self._file.read(min(size, length))
                if not found and length:
                    raise OSError("it became shorter while it was read")
                rest_of_it = (start + len(found), length - len(found))
                self._pieces[:1] = [rest_of_it] if rest_of_it[1] else []
            if found:
                return found
        return b""

    def _count(self, found: bytes) -> None:
        text = self._rest + found
        end = text.rfind(b"\n") + 1
        text, self._rest = text[:end], text[end:]
        self._lines += text.count(b"\n")
        self._plain_lines += sum(text.count(b") can%d " % number) for number in range(8))

    def is_independent(self) -> bool:
        """Whether its content means the same without what comes before: a log's interfaces get their channels in the order of the names, except can0 to can7."""
        return self._lines == self._plain_lines

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def together(entries: Sequence[Entry], is_by_time: bool) -> Entry | None:
    """The entry of a trace whose parts have these; `None` if one is not as it should be, so that the trace is to be read as one. What is left out is
    that of the whole trace already if it was divided by time."""
    if any(entry.state not in (READ, UNDECODED, EMPTY) or entry.issues for entry in entries):
        return None
    whole = Entry(**entries[0].to_dict())
    for entry in entries[1:]:
        for count in ("records", "frames", "lost", "bus_errors", "decoded", "signal_rows"):
            setattr(whole, count, getattr(whole, count) + getattr(entry, count))
        whole.lost_at_least |= entry.lost_at_least
        for kinds, more in () if is_by_time else ((whole.left_out, entry.left_out), (whole.notes, entry.notes)):
            for what, number in more.items():
                kinds[what] = kinds.get(what, 0) + number
    if entries[0].coverage is not None:
        whole.coverage = whole.decoded / whole.frames if whole.frames else None
    is_undecoded = all(entry.state == UNDECODED for entry in entries)
    whole.state, whole.problem = (UNDECODED, entries[0].problem) if is_undecoded else (READ, None)
    return whole


def default_part_bytes(size: int, workers: int) -> int:
    """Parts that are long enough to be worth it, and enough of them for all workers."""
    return max(64 << 20, min(512 << 20, size // (4 * workers)))
