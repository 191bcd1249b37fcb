"""Which files a trace is: a path, a pattern, a URL."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

TraceFile: TypeAlias = "str | os.PathLike[str] | tuple[str, Callable[[], Any]]"
"""A path, or the name of a file and a function that opens it."""


def files(path: str) -> list[TraceFile]:
    """The files of a path, of a pattern or of a URL of fsspec, by their names."""
    return list(_of_path(path))


def _of_path(path: str) -> Iterator[TraceFile]:
    if re.match(r"[a-z][a-z0-9+.-]+://", path):
        yield from _of_url(path)
    elif glob.has_magic(path) and not os.path.exists(path):
        found = sorted((name for name in glob.glob(path, recursive=True) if os.path.isfile(name)), key=in_order)
        if not found:
            raise FileNotFoundError(f"no file is called like {path}")
        yield from found
    else:
        yield path


def _of_url(url: str) -> Iterator[TraceFile]:
    try:
        import fsspec
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{url} is read by fsspec; install it: pip install 'cantap[lake]'", name="fsspec") from error
    system, path = fsspec.url_to_fs(url)
    if glob.has_magic(path):
        names = [name for name in system.glob(path) if not system.isdir(name)]
    else:
        names = [path]
    if not names:
        raise FileNotFoundError(f"no file is called like {url}")
    for name in sorted(names, key=in_order):
        yield system.unstrip_protocol(name), _Opener(system, name)


class _Opener:
    """Opens a file of fsspec when it is its turn: ranges are read, ahead of what is asked for. It can be pickled."""

    def __init__(self, system: Any, name: str) -> None:
        self._system, self._name = system, name

    def __call__(self) -> Any:
        return self._system.open(self._name, "rb", block_size=8 << 20, cache_type="readahead")


def in_order(name: str) -> list[tuple[int, int, str]]:
    """So that `2.mf4` is before `10.mf4`."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name)]
