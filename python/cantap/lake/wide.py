"""A lake's signals in the wide layout, for whoever speaks SQL: a view for each message, with a row for each frame and a column for each signal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import pyarrow as pa
import pyarrow.compute as pc

#: What each of these views has besides, and a frame's signals have in common.
COLUMNS = ("vehicle", "day", "channel", "trace", "time", "time_ns", "id", "extended")
SCHEMA = "messages"


def wide_views(signals: pa.dataset.Dataset) -> list[str]:
    """Statements of DuckDB that make the views, over the view `signals` with these rows."""
    taken: set[str] = set()
    names = _names(signals.to_batches(columns=["message", "signal", "text"]))
    return [f"CREATE SCHEMA IF NOT EXISTS {SCHEMA};", *(_view(message, of_message, taken) for message, of_message in sorted(names.items()))]


def _names(batches: Iterable[pa.RecordBatch]) -> dict[str, dict[str, bool]]:
    """The signals of each message, and whether they have texts."""
    found: dict[str, dict[str, bool]] = {}
    for batch in batches:
        rows = pa.table({**{name: batch.column(name) for name in ("message", "signal")}, "has_text": pc.is_valid(batch.column("text"))})
        for row in rows.group_by(["message", "signal"]).aggregate([("has_text", "any")]).to_pylist():
            if row["message"] is not None:
                of_message = found.setdefault(row["message"], {})
                of_message[row["signal"]] = of_message.get(row["signal"], False) or row["has_text_any"]
    return found


def _view(message: str, signals: dict[str, bool], taken: set[str]) -> str:
    """Frames of a message at one nanosecond, as in traces of milliseconds, are told apart by the signal that each begins with."""
    used = set(COLUMNS)
    columns = [f"{name(each)}" for each in COLUMNS]
    for signal, has_text in sorted(signals.items()):
        for value, suffix in (("value", ""), *([("text", ".text")] if has_text else ())):
            column = _free(signal + suffix, f"{message}.{signal}{suffix}", used)
            columns.append(f"max({value}) FILTER (WHERE signal = {text(signal)}) AS {name(column)}")
    of_frame = ", ".join(map(name, COLUMNS))
    window = f"OVER (PARTITION BY {of_frame} ORDER BY row)"
    rows = f"SELECT *, first_value(signal) {window} AS begins_with FROM signals WHERE message = {text(message)}"
    frames = f"SELECT *, count(*) FILTER (WHERE signal = begins_with) {window} AS nth FROM ({rows})"
    view = f"{SCHEMA}.{name(_free(message, message, taken))}"
    return f"CREATE OR REPLACE VIEW {view} AS SELECT {', '.join(columns)} FROM ({frames}) GROUP BY {of_frame}, nth;"


def _free(wanted: str, other: str, used: set[str]) -> str:
    """A name that nothing else has yet: to DuckDB `speed` is `Speed`."""
    candidates: Iterator[str] = (f"{other} {number}" if number > 1 else choice for number, choice in enumerate([wanted, other, *[""] * len(used)]))
    found = next(candidate for candidate in candidates if candidate.lower() not in used)
    used.add(found.lower())
    return found


def text(text: str) -> str:
    """A text of SQL."""
    return "'" + text.replace("'", "''") + "'"


def name(name: str) -> str:
    """A name of SQL."""
    return '"' + name.replace('"', '""') + '"'
