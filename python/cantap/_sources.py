"""Which files a trace is: a path, a pattern, a folder, a URL, an open file, or several of them."""

from __future__ import annotations

import glob
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias

from ._native import CantapWarning, Table, is_trace_name

TraceFile: TypeAlias = "str | os.PathLike[str] | tuple[str, Callable[[], Any]]"
"""A path, or the name of a file and a function that opens it."""

DATABASE_SUFFIXES = (".dbc", ".kcd", ".sym", ".arxml", ".dbf", ".toml")
"""Files that may well lie beside the traces that they decode."""


def files(source: Any) -> list[TraceFile]:
    """The files of a source, in the order in which they are read: those of a pattern or a folder by their names."""
    found = list(_files(source, True))
    if not found:
        raise ValueError("no file is given; name at least one")
    return found


def is_file(source: Any) -> bool:
    """Whether it is one file, or a name of files."""
    return isinstance(source, (str, os.PathLike)) or hasattr(source, "read") or _is_of_fsspec(source)


def _is_of_fsspec(source: Any) -> bool:
    """Whether it is what `fsspec.open` returns."""
    return all(hasattr(source, name) for name in ("open", "fs", "path"))


def _files(source: Any, may_be_several: bool) -> Iterator[TraceFile]:
    if isinstance(source, (str, os.PathLike)):
        yield from _of_path(os.fspath(source))
    elif _is_of_fsspec(source):
        yield str(source.path), source.open
    elif hasattr(source, "read"):
        name = getattr(source, "name", None)
        yield name if isinstance(name, str) else "the file object", lambda: _Borrowed(source)
    elif may_be_several and isinstance(source, Iterable) and not isinstance(source, (bytes, bytearray, dict, Table)):
        for one in source:
            yield from _files(one, False)
    else:
        raise TypeError(f"path is a file's name, an open file, or several of them, not {type(source).__name__}")


def _of_path(path: Any) -> Iterator[TraceFile]:
    if not isinstance(path, str):
        yield path
    elif is_url(path):
        yield from _of_url(path)
    elif os.path.isdir(path):
        yield from _of_folder(path)
    elif glob.has_magic(path) and not os.path.exists(path):
        found = sorted((name for name in glob.glob(path, recursive=True) if os.path.isfile(name)), key=in_order)
        if not found:
            raise FileNotFoundError(f"no file is called like {path}")
        yield from found
    else:
        yield path


def file_system(url: str) -> tuple[Any, str]:
    """The file system of fsspec that a URL is in, and the path there."""
    try:
        import fsspec
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{url} is read by fsspec; install it: pip install 'cantap[fsspec]'", name="fsspec") from error
    system, path = fsspec.url_to_fs(url)
    # It remembers listings for as long as the program runs: what has come since would be left out.
    system.invalidate_cache()
    return system, path


def _of_url(url: str) -> Iterator[TraceFile]:
    system, path = file_system(url)
    # A name may have brackets itself.
    if glob.has_magic(path) and not system.exists(path):
        names = _files_among(system, system.glob(path, detail=True).values())
    elif system.isdir(path):
        names = [*own_file(system, path), *_traces(url, _files_among(system, system.ls(path, detail=True)))]
    else:
        names = [path]
    if not names:
        raise FileNotFoundError(f"no file is called like {url}")
    for name in sorted(names, key=in_order):
        yield opener(system, name)


def _files_among(system: Any, entries: Iterable[Any]) -> list[str]:
    """The names of the files in a listing. In an object store a name may be a file's and a folder's: `a.blf` beside `a.blf/b.blf`."""
    found: dict[str, bool] = {}
    for entry in entries:
        found[entry["name"]] = found.get(entry["name"], False) or entry["type"] == "file"
    # Of such a name a pattern's listing may have the folder alone.
    return [name for name, is_file in found.items() if is_file or is_trace_name(name) and _has_content(system, name)]


def own_file(system: Any, path: str) -> list[str]:
    """A folder's name, if it is a file's, too."""
    return [path] if is_trace_name(path) and _has_content(system, path) else []


def _has_content(system: Any, name: str) -> bool:
    try:
        with system.open(name, "rb") as file:
            file.read(1)
    except OSError:
        return False
    return True


def opener(system: Any, name: str) -> tuple[str, Callable[[], Any]]:
    """A file of a file system of fsspec: what it is called, and what opens it."""
    return system.unstrip_protocol(name), _Opener(system, name)


def is_url(path: Any) -> bool:
    """Whether fsspec is to open it."""
    return isinstance(path, str) and re.match(r"[a-z][a-z0-9+.-]+://", path) is not None


class _Opener:
    """Opens a file of fsspec when it is its turn: ranges are read, ahead of what is asked for. It can be pickled."""

    def __init__(self, system: Any, name: str) -> None:
        self._system, self._name = system, name

    def __call__(self) -> Any:
        try:
            return self._system.open(self._name, "rb", block_size=8 << 20, cache_type="readahead")
        except FileNotFoundError as error:
            # A store's own words do not say which.
            raise FileNotFoundError(f"{self._system.unstrip_protocol(self._name)}: {error}") from error


class _Borrowed:
    """A file object of the caller's, who closes it."""

    def __init__(self, file: Any) -> None:
        self.read = file.read


def _of_folder(folder: str) -> Iterator[TraceFile]:
    names = [entry.path for entry in os.scandir(folder) if entry.is_file()]
    found = _traces(folder, names)
    if not found:
        raise FileNotFoundError(f"{folder} has no file with the name of a trace; name the files, or a pattern such as {folder}/**/*.mf4")
    yield from sorted(found, key=in_order)


def _traces(folder: str, names: list[str]) -> list[str]:
    """The traces among the files in a folder. What else there is must be known."""
    visible = [name for name in names if not os.path.basename(name).startswith(".")]
    found = [name for name in visible if is_trace_name(name)]
    others = sorted(set(visible) - set(found))
    others = [os.path.basename(name) for name in others if not name.lower().endswith(DATABASE_SUFFIXES)]
    if others:
        shown = ", ".join(others[:3]) + (", …" if len(others) > 3 else "")
        warnings.warn(f"{folder}: {len(others)} files without the name of a trace were left out: {shown}", CantapWarning, stacklevel=2)
    return found


def in_order(name: str) -> list[tuple[int, int, str]]:
    """So that `2.mf4` is before `10.mf4`."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name)]
