"""Which files a trace is: a path, a pattern, a folder, a URL, an open file, or several of them."""

from __future__ import annotations

import glob
import os
import posixpath
import re
import sys
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
        names = _files_matching(system, path)
    elif system.isdir(path):
        names = [*own_file(system, path), *_traces(url, _objects(system.ls(path, detail=True)))]
    else:
        names = [path]
    if not names:
        raise FileNotFoundError(f"no file is called like {url}")
    for name in sorted(names, key=in_order):
        yield opener(system, name)


def _files_matching(system: Any, pattern: str) -> list[str]:
    """The files whose names a pattern fits. In an object store a name may be a file's and a folder's, `a.blf` beside `a.blf/b.blf`, and of such a name
    the answer has the folder alone: the listing that it is in has both."""
    found = {name: entry["type"] for name, entry in system.glob(pattern, detail=True).items()}
    folders = {name for name, kind in found.items() if kind == "directory"}
    above = {posixpath.dirname(name) for name in folders} - {""}
    both = {entry["name"] for folder in above for entry in system.ls(folder, detail=True) if entry["type"] == "file"}
    return [name for name, kind in found.items() if kind == "file" or name in both]


def _objects(entries: Iterable[Any]) -> list[str]:
    """The names of the files in a listing, without what some programs make of an empty folder: an empty object whose name ends like a folder's."""
    return [entry["name"] for entry in entries if entry["type"] == "file" and not (entry["name"].endswith("/") and not entry["size"])]


def own_file(system: Any, folder: str) -> list[str]:
    """A folder's name, if it is a file's, too."""
    # What is known of it from a listing may be the folder alone.
    system.invalidate_cache(folder)
    try:
        about = system.info(folder)
    except OSError:
        return []
    # Without content it is what some programs make of a folder.
    return [folder] if about["type"] == "file" and (about["size"] or is_trace_name(folder)) else []


def opener(system: Any, name: str) -> tuple[str, Callable[[], Any]]:
    """A file of a file system of fsspec: what it is called, and what opens it."""
    return _url(system, name), _Opener(system, name)


def _url(system: Any, name: str) -> str:
    return str(system.unstrip_protocol(name)).rstrip("/") + "/" * name.endswith("/")


def is_url(path: Any) -> bool:
    """Whether fsspec is to open it."""
    return isinstance(path, str) and re.match(r"[a-z][a-z0-9+.-]+://", path) is not None


class _Opener:
    """Opens a file of fsspec when it is its turn: ranges are read, ahead of what is asked for. It can be pickled."""

    def __init__(self, system: Any, name: str) -> None:
        self._system, self._name = system, name

    def __call__(self) -> Any:
        if self._name.endswith("/"):
            raise OSError(f"{_url(self._system, self._name)}: a name that ends like a folder's cannot be opened; copy it to another")
        # A listing says of `a` beside `a/b` that it is a folder, which would be read as empty; and what it says of a file may be of an older one.
        self._system.invalidate_cache(self._name)
        try:
            file = self._system.open(self._name, "rb", block_size=8 << 20, cache_type="readahead")
        except FileNotFoundError as error:
            # A store's own words do not say which.
            raise FileNotFoundError(f"{_url(self._system, self._name)} does not exist: {error}") from error
        # Of a file that is gone, whose name others begin with, only the folder is left.
        if (getattr(file, "details", None) or {}).get("type") == "directory":
            raise FileNotFoundError(f"{_url(self._system, self._name)} does not exist, only what is below it")
        return file


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
    others = [os.path.basename(name) or name for name in others if not name.lower().endswith(DATABASE_SUFFIXES)]
    if others:
        shown = ", ".join(others[:3]) + (", …" if len(others) > 3 else "")
        several = "files without the name of a trace were" if len(others) > 1 else "file without the name of a trace was"
        _warn(f"{folder}: {len(others)} {several} left out: {shown}")
    return found


def _warn(text: str) -> None:
    """A warning for the line of the program that called this package, however deep it is in here."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == "cantap":
        frame, level = frame.f_back, level + 1
    warnings.warn(text, CantapWarning, stacklevel=level)


def in_order(name: str) -> list[tuple[int, int, str]]:
    """So that `2.mf4` is before `10.mf4`."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name)]
