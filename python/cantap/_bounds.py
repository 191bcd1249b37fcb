"""What a filter of pyarrow says about times and signals: as much as is certain, because the filter itself is applied afterwards.

pyarrow does not show what an expression consists of, but prints it. Only conditions that all rows must meet are used, those which are
joined by `and` at the top; anything that is not understood bounds nothing.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from typing import Any

TOKEN = re.compile(r'\s*(?:("(?:[^"\\]|\\.)*")|(\(|\)|\[|\]|,|==|!=|<=|>=|<|>|=|!)|([^\s()\[\],<>=!"]+))')
COMPARISONS = ("==", "<", "<=", ">", ">=")
CALL = "()"
"""Follows the name of a function, before its arguments."""
MIRRORED = {"==": "==", "<": ">", "<=": ">=", ">": "<", ">=": "<="}


@dataclass
class Bounds:
    """Bounds that all wanted rows meet."""

    start: str | None = None
    """The earliest time, as the command writes it."""
    end: str | None = None
    """A time that is later than all."""
    signals: set[str] | None = None
    """The only signals."""

    def narrow(self, start: str | None, end: str | None) -> tuple[str | None, str | None]:
        """Bounds that were asked for, or these where none were: both are met in any case."""
        return (self.start if start is None else start), (self.end if end is None else end)


def bounds(filter: Any, schema: Any) -> Bounds:
    """The bounds in a filter."""
    found = Bounds()
    if filter is None:
        return found
    names = set(schema.names)
    if not all(re.fullmatch(r"[\w.-]+", name) for name in names):
        # Names are printed without quotes: others could look like conditions.
        return found
    for condition in _conditions(_parse(str(filter))):
        _take(condition, names, found)
    return found


def _take(condition: list[Any], names: set[str], found: Bounds) -> None:
    if condition[:2] == ["is_in", CALL]:
        signals = _listed(condition[2:])
        if signals is not None:
            found.signals = signals if found.signals is None else found.signals & signals
        return
    if len(condition) != 3 or not all(isinstance(part, str) for part in condition) or condition[1] not in COMPARISONS:
        return
    left, how, right = condition
    if left not in names:
        left, how, right = right, MIRRORED[how], left
    if left == "signal" and how == "==" and right.startswith('"') and "\\" not in right:
        found.signals = {right[1:-1]} if found.signals is None else found.signals & {right[1:-1]}
    time_ns = _time_ns(right) if left == "time" else None
    if time_ns is None:
        return
    if how in (">", ">=", "=="):
        start = _text(time_ns)
        found.start = start if found.start is None else max(found.start, start)
    if how in ("<", "<=", "=="):
        # The end is exclusive.
        end = _text(time_ns + 1)
        found.end = end if found.end is None else min(found.end, end)


def _listed(arguments: list[Any]) -> set[str] | None:
    """The signals in `is_in(signal, {value_set=string:["a", "b"], …})`. A long list is printed in part."""
    lists = [part for part in arguments if isinstance(part, list)]
    if arguments[:2] != ["signal", ","] or len(lists) != 1 or "..." in lists[0]:
        return None
    texts = [text for text in lists[0] if text != ","]
    if not all(isinstance(text, str) and len(text) > 1 and text[0] == text[-1] == '"' and "\\" not in text for text in texts):
        return None
    return {text[1:-1] for text in texts}


def _time_ns(text: str) -> int | None:
    match = re.fullmatch(r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?Z", text)
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(match.group(at)) for at in range(1, 7))
    try:
        date = datetime.datetime(year, month, day, hour, minute, second, tzinfo=datetime.timezone.utc)
    except ValueError:
        return None
    since = date - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    return (since.days * 86_400 + since.seconds) * 10**9 + int((match.group(7) or "").ljust(9, "0"))


def _text(time_ns: int) -> str:
    seconds, ns = divmod(time_ns, 10**9)
    date = datetime.datetime(1970, 1, 1) + datetime.timedelta(seconds=seconds)
    return f"{date.isoformat(timespec='seconds')}.{ns:09}"


def _conditions(tree: Any) -> list[Any]:
    """The conditions that are joined by `and`, which prints as `((a and b) and c)`."""
    while isinstance(tree, list) and len(tree) == 1:
        tree = tree[0]
    if not isinstance(tree, list):
        return []
    if len(tree) >= 3 and all(part == "and" for part in tree[1::2]) and len(tree) % 2 == 1:
        return [condition for part in tree[::2] for condition in _conditions(part)]
    return [tree]


def _parse(text: str) -> Any:
    """A printed expression as nested lists; an empty one if it is not understood."""
    # A date is printed with a blank inside.
    text = re.sub(r"(\d{4}-\d\d-\d\d) (\d\d:\d\d:\d\d)", r"\1T\2", _without_texts(text))
    stack: list[list[Any]] = [[]]
    at = 0
    while at < len(text.rstrip()):
        match = TOKEN.match(text, at)
        if match is None:
            return []
        at = match.end()
        token = match.group(1) or match.group(2) or match.group(3)
        if token in "([":
            # A name before it is a function's.
            before = stack[-1][-1] if stack[-1] else None
            is_call = token == "(" and isinstance(before, str) and before not in ("and", "or", ",", "=", *COMPARISONS)
            stack.append([stack[-1].pop(), CALL] if is_call else [])
        elif token in ")]":
            if len(stack) == 1:
                return []
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(token)
    return stack[0] if len(stack) == 1 else []


def _without_texts(text: str) -> str:
    """Dates inside of quoted texts stay as they are."""
    return re.sub(r'"(?:[^"\\]|\\.)*"', lambda quoted: quoted.group().replace("-", "\\-") if re.search(r"\d{4}-\d\d-\d\d ", quoted.group()) else quoted.group(), text)
