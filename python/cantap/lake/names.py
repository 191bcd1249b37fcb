"""What a lake's own files are called. A lake may come from somebody else: by a name that led out of its folder, other files would be replaced or removed."""

from __future__ import annotations

import re
from typing import Any

from .writing import TABLES

_CONTENT = re.compile(r"[0-9a-f]{64}")


def is_content(sha256: Any) -> bool:
    """Whether it is the digest of a content, by which its entry is called."""
    return isinstance(sha256, str) and _CONTENT.fullmatch(sha256) is not None


def is_own(name: Any) -> bool:
    """Whether a file of this name is one of a table's, below the lake's folder."""
    if not isinstance(name, str) or not name.isprintable() or "\\" in name or ":" in name:
        return False
    table, *parts = name.split("/")
    return table in TABLES and name.endswith(".parquet") and len(parts) > 0 and not {"", ".", ".."} & set(parts)


def are_own(files: Any) -> bool:
    """Whether these are such files, each with its rows."""
    return isinstance(files, dict) and all(is_own(name) and type(rows) is int and rows >= 0 for name, rows in files.items())
