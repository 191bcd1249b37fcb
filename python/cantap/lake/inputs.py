"""The traces that go into a lake, wherever they are."""

from __future__ import annotations

import hashlib
import os
import posixpath
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .._native import is_trace_name
from .._sources import file_system, files, in_order, is_url, opener, own_file

CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class Trace:
    """A file, by its name and by how to open it."""

    name: str
    """As the ledger calls it."""
    vehicle: str
    source: Any
    """A path, or a function that opens it."""

    def fetch(self, folder: Path) -> Fetched:
        """Its content: a file of the system stays where it is, another is copied into the folder."""
        digest = hashlib.sha256()
        is_local = isinstance(self.source, str)
        # The suffix determines the format. The rest of an object's name may be anything: longer than a file's, or `..`.
        path = Path(self.source) if is_local else folder / f"trace{_suffixes(self.name)}"
        before = _stamp(path) if is_local else None
        size = 0
        file = open(path, "rb") if is_local else self.source()
        try:
            with open(os.devnull if is_local else path, "wb") as copy:
                while chunk := file.read(CHUNK_BYTES):
                    digest.update(chunk)
                    copy.write(chunk)
                    size += len(chunk)
        finally:
            file.close()
        return Fetched(path, digest.hexdigest(), size, not is_local, before)


@dataclass(frozen=True)
class Fetched:
    """A trace on this machine."""

    path: Path
    sha256: str
    bytes: int
    is_copy: bool
    stamp: tuple[int, int] | None
    """Its length, and when it was last changed, before it was read; of a copy nothing is needed."""

    def is_unchanged(self) -> bool:
        """Whether what is decoded is what its digest is of."""
        try:
            return self.stamp is None or self.stamp == _stamp(self.path)
        except OSError:
            return False

    def discard(self) -> None:
        """Removes the copy, if it is one."""
        if self.is_copy:
            self.path.unlink(missing_ok=True)


def _suffixes(name: str) -> str:
    """`.log.gz` of `drive 7.log.gz`; empty if what is there is no suffix."""
    found = re.search(r"(\.[A-Za-z0-9_-]{1,16}){1,2}$", posixpath.basename(name))
    return found[0] if found else ""


def _stamp(path: Path) -> tuple[int, int]:
    about = path.stat()
    return about.st_size, about.st_mtime_ns


def traces(sources: Iterable[str], vehicle: str | None = None) -> list[Trace]:
    """The traces of files, patterns, folders with everything below them, and URLs of fsspec.

    A trace's vehicle is the first folder below a folder that was given, otherwise the folder that the file is in.
    """
    found: dict[str, Trace] = {}
    for source in sources:
        folder = Path(source)
        if folder.is_dir():
            below = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
            for path in sorted(below, key=lambda path: in_order(str(path))):
                parts = path.relative_to(folder).parts
                first = parts[0] if len(parts) > 1 else folder.resolve().name
                found[str(path)] = Trace(str(path), vehicle or first, str(path))
            continue
        if is_url(source) and (of_folder := _below(source)) is not None:
            for below_it, (name, opened) in of_folder:
                found[name] = Trace(name, vehicle or below_it[0], opened)
            continue
        for file in files(source):
            name, opened = file if isinstance(file, tuple) else (os.fspath(file), os.fspath(file))
            above = posixpath.basename(posixpath.dirname(name.replace(os.sep, "/")))
            found[name] = Trace(name, vehicle or above or "unknown", opened)
    return list(found.values())


def _below(url: str) -> list[tuple[list[str], tuple[str, Any]]] | None:
    """All files below a folder of fsspec, hidden ones apart: the parts of each one's name from the folder on, beginning with the folder's own name if it lies
    directly in it; `None` if it is no folder."""
    system, path = file_system(url)
    if not system.isdir(path):
        return None
    path = path.rstrip("/")
    own = posixpath.basename(path) or "unknown"
    found = [([posixpath.basename(posixpath.dirname(name)) or "unknown"], opener(system, name)) for name in own_file(system, path)]
    objects = {name: about["size"] for name, about in system.find(path, detail=True).items()}
    folders = _folders(objects)
    for name in sorted(objects, key=in_order):
        parts = [part for part in name[len(path) :].split("/") if part]
        # An empty object that is called like a folder is what some programs make of one.
        is_folder = not objects[name] and (name.endswith("/") or name in folders and not is_trace_name(name))
        if parts and name != path and not parts[-1].startswith(".") and not is_folder:
            found.append((parts if len(parts) > 1 else [own, *parts], opener(system, name)))
    if not found:
        raise FileNotFoundError(f"there is no file below {url}")
    return found


def _folders(names: Iterable[str]) -> set[str]:
    """All folders that the names are in, and those that these are in."""
    found: set[str] = set()
    for name in names:
        while (name := posixpath.dirname(name)) and name not in found:
            found.add(name)
    return found
