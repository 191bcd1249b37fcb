"""A lake's signals as lines of InfluxDB's line protocol, as InfluxDB, Telegraf, VictoriaMetrics and QuestDB read it.

    can,channel=1,message=Engine,vehicle=007 Speed=12.5,Gear=3,Gear.text="third" 1772409590000000000

A line is a frame: its signals are fields, numbers of 64 bits, and the texts of value tables besides. Losses and errors are lines of `can_events`. The
source of the format is InfluxData's "Line protocol reference" (InfluxDB v2).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

_COLUMNS = ["vehicle", "channel", "time_ns", "event", "detail", "count", "at_least", "id", "message", "signal", "value", "text"]


@dataclass
class Left:
    """What has no place in the format."""

    values: int = 0
    """Values that are none, such as "not available", infinite or not a number."""
    frames: int = 0
    """Frames with no others."""


def lines(batches: Iterable[pa.RecordBatch], left: Left) -> Iterator[str]:
    """The lines of rows of `signals`, without line ends; what is left out is counted in `left`."""
    for batch in batches:
        frame: tuple[Any, ...] | None = None
        fields: list[str] = []
        for row in batch.select(_COLUMNS).to_pylist():
            of_row = (row["vehicle"], row["channel"], row["time_ns"], row["id"], row["message"])
            # Two frames of a message at one moment would be one point of two values.
            if of_row != frame or _begins(fields, row):
                yield from _frame(frame, fields, left)
                frame, fields = of_row, []
            if row["event"] != "value":
                yield _event(row)
                frame = None
            else:
                fields += _fields(row, left)
        yield from _frame(frame, fields, left)


def _begins(fields: list[str], row: dict[str, Any]) -> bool:
    return row["event"] == "value" and any(field.startswith(f"{_key(row['signal'])}=") for field in fields)


def _frame(frame: tuple[Any, ...] | None, fields: list[str], left: Left) -> Iterator[str]:
    if frame is None:
        return
    vehicle, channel, time_ns, _, message = frame
    if fields:
        yield f"can{_tags(channel=channel, message=message, vehicle=vehicle)} {','.join(fields)} {time_ns}"
    else:
        left.frames += 1


def _fields(row: dict[str, Any], left: Left) -> list[str]:
    fields = []
    value = row["value"]
    if value is not None and math.isfinite(value):
        fields.append(f"{_key(row['signal'])}={value!r}")
    else:
        left.values += 1
    if row["text"] is not None:
        fields.append(f"{_key(row['signal'] + '.text')}={_string(row['text'])}")
    return fields


def _event(row: dict[str, Any]) -> str:
    fields = ["at_least=true" if row["at_least"] else "at_least=false", f"count={row['count'] or 1}i"]
    if row["detail"] is not None:
        fields.append(f"detail={_string(row['detail'])}")
    return f"can_events{_tags(channel=row['channel'], event=row['event'], vehicle=row['vehicle'])} {','.join(fields)} {row['time_ns']}"


def _tags(**tags: Any) -> str:
    """In the order of their names, as the reference recommends; an empty one is not allowed."""
    return "".join(f",{name}={_key(str(value))}" for name, value in tags.items() if value not in (None, ""))


def _key(text: str) -> str:
    """A name, or a tag's value. A backslash can neither be escaped nor stand at the end, a line end not at all."""
    return re.sub(r"([,= ])", r"\\\1", _in_line(text).replace("\\", "/"))


def _string(text: str) -> str:
    return '"' + _in_line(text).replace("\\", "\\\\").replace('"', '\\"') + '"'


def _in_line(text: str) -> str:
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)
