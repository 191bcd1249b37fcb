"""The input: the traces under a folder, and what is known about each vehicle."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from pyspark.sql import SparkSession

#: Lines with this name are for vehicles without a line of their own.
ANY_VEHICLE = "*"
_FIELDS = ["vehicle", "channel", "databases", "bitrate", "data_bitrate", "j1939"]


class InputError(Exception):
    """The job cannot begin; the message says why."""


@dataclass(frozen=True)
class File:
    """A file of the input folder."""

    #: As Hadoop writes it: with its scheme, and unescaped.
    url: str
    #: Under the input folder, with `/`.
    name: str
    bytes: int

    @property
    def vehicle(self) -> str | None:
        """The first folder in its name; `None` for a file that is in no folder."""
        first, slash, _ = self.name.partition("/")
        return first if slash else None


@dataclass(frozen=True)
class Bus:
    """What is known about a vehicle's channel, or all its channels."""

    vehicle: str
    #: From 1; `None` for all channels without a line of their own.
    channel: int | None
    #: Names under the input folder.
    databases: tuple[str, ...]
    #: Bits per second; `None` if unknown.
    bitrate: int | None
    data_bitrate: int | None
    j1939: bool


def files_of(spark: SparkSession, folder: str) -> list[File]:
    """All files under a folder in any of Hadoop's file systems, by name, including hidden ones."""
    # Spark's own sources silently skip names that begin with `_` or `.`.
    java = spark.sparkContext._jvm
    configuration = spark.sparkContext._jsc.hadoopConfiguration()
    assert java is not None
    path = java.org.apache.hadoop.fs.Path(folder)
    system = path.getFileSystem(configuration)
    if not system.exists(path):
        raise InputError(f"{folder}: there is no such folder")
    status = system.getFileStatus(path)
    if not status.isDirectory():
        raise InputError(f"{folder} is a file; give the folder that has a folder for each vehicle")
    root = status.getPath().toString().rstrip("/")
    found = (_file(status, root) for status in _each(system.listFiles(path, True)))
    return sorted(found, key=lambda file: file.name)


def _each(remote: Any) -> Iterator[Any]:
    while remote.hasNext():
        yield remote.next()


def _file(status: Any, root: str) -> File:
    url = status.getPath().toString()
    return File(url, url[len(root) + 1 :], status.getLen())


def contents_of(spark: SparkSession, urls: Iterable[str]) -> dict[str, bytes]:
    """Small files, whole."""
    java = spark.sparkContext._jvm
    configuration = spark.sparkContext._jsc.hadoopConfiguration()
    assert java is not None
    contents = {}
    for url in urls:
        path = java.org.apache.hadoop.fs.Path(url)
        stream = path.getFileSystem(configuration).open(path)
        try:
            contents[url] = bytes(java.org.apache.commons.io.IOUtils.toByteArray(stream))
        finally:
            stream.close()
    return contents


def buses_of(text: str, name: str) -> list[Bus]:
    """The vehicles' table. Its columns are vehicle, channel, databases, bitrate, data_bitrate, j1939, of which the first is needed."""
    reader = csv.DictReader(io.StringIO(text.removeprefix("\ufeff")))
    fields = reader.fieldnames or []
    unknown = [field for field in fields if field not in _FIELDS]
    if "vehicle" not in fields or unknown:
        raise InputError(f"{name}: its first line has the columns' names: {', '.join(_FIELDS)}")
    buses: dict[tuple[str, int | None], Bus] = {}
    for line in reader:
        where = f"{name}, line {reader.line_num}"
        values = {field: (line.get(field) or "").strip() for field in _FIELDS}
        if not values["vehicle"] or None in line:
            raise InputError(f"{where}: a line has a vehicle, and as many values as there are columns")
        if values["j1939"] not in ("", "yes", "no"):
            raise InputError(f"{where}: j1939 is yes or no, not '{values['j1939']}'")
        bus = Bus(
            values["vehicle"],
            _number(values["channel"], f"{where}: channel", 255),
            tuple(filter(None, (part.strip() for part in values["databases"].split(";")))),
            _number(values["bitrate"], f"{where}: bitrate", 20_000_000),
            _number(values["data_bitrate"], f"{where}: data_bitrate", 20_000_000),
            values["j1939"] == "yes",
        )
        if (bus.vehicle, bus.channel) in buses:
            raise InputError(f"{where}: vehicle {bus.vehicle} has this channel twice; join databases with ';'")
        buses[bus.vehicle, bus.channel] = bus
    return list(buses.values())


def _number(text: str, what: str, most: int) -> int | None:
    if not text:
        return None
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= most):
        raise InputError(f"{what} is a number from 1 to {most}, or nothing, not '{text}'")
    return int(text)


def buses_by_vehicle(buses: Iterable[Bus], vehicles: Iterable[str]) -> dict[str, list[Bus]]:
    """The lines for each vehicle: its own, otherwise those for any vehicle."""
    named: dict[str, list[Bus]] = {}
    for bus in buses:
        named.setdefault(bus.vehicle, []).append(bus)
    return {vehicle: named.get(vehicle, named.get(ANY_VEHICLE, [])) for vehicle in vehicles}
