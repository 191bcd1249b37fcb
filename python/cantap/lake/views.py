"""A lake for whoever speaks SQL: views of DuckDB over the files that the ledger names."""

from __future__ import annotations

from .store import Store, StoreError
from .wide import name as name_of
from .wide import text, wide_views
from .writing import TABLES

_TYPES = {
    "string": "VARCHAR",
    "date": "DATE",
    "smallint": "SMALLINT",
    "int": "INTEGER",
    "bigint": "BIGINT",
    "boolean": "BOOLEAN",
    "double": "DOUBLE",
    "binary": "BLOB",
    "decimal(20,0)": "DECIMAL(20, 0)",
    "timestamp": "TIMESTAMP WITH TIME ZONE",
}
_LEDGER = {
    "trace": "VARCHAR",
    "vehicle": "VARCHAR",
    "state": "VARCHAR",
    "problem": "VARCHAR",
    "format": "VARCHAR",
    "bytes": "BIGINT",
    "records": "BIGINT",
    "frames": "BIGINT",
    "lost": "BIGINT",
    "lost_at_least": "BOOLEAN",
    "bus_errors": "BIGINT",
    "decoded": "BIGINT",
    "coverage": "DOUBLE",
    "signal_rows": "BIGINT",
    "issues": "BIGINT",
    "properties": "MAP(VARCHAR, VARCHAR)",
    "sha256": "VARCHAR",
}
#: DuckDB takes these in a name for a pattern, and knows no way to write them otherwise.
_PATTERN = "*?["


def views(lake: Store, *, wide: bool = False) -> str:
    """Statements that make the views `frames`, `signals` and `ledger` in a database of DuckDB; with `wide` also one for each message, with a column for each
    of its signals, such as `messages."Engine"`. They have the files of now: after traces were added or files joined, they are to be made again."""
    folder = lake.folder.resolve()
    if any(letter in str(folder) for letter in _PATTERN):
        raise StoreError(f"{folder}: DuckDB would take this name for a pattern; give the lake one without any of {' '.join(_PATTERN)}")
    made = [_view(name, _rows([str(folder / file) for file in lake.files(name)], TABLES[name])) for name in TABLES]
    kinds = ", ".join(f"{name}: {text(kind)}" for name, kind in _LEDGER.items())
    entries = text(str(folder / "ledger" / "*.json"))
    is_empty = next(lake.entries(), None) is None
    made.append(_view("ledger", _none(_LEDGER) if is_empty else f"SELECT * FROM read_json({entries}, format = 'newline_delimited', columns = {{{kinds}}})"))
    if wide:
        made += wide_views(lake.dataset("signals"))
    return "\n".join(made) + "\n"


def _rows(files: list[str], kinds: dict[str, str]) -> str:
    if not files:
        return _none({name: _TYPES[kind] for name, kind in kinds.items()})
    # Folders are named by what is in their files' columns.
    return f"SELECT * FROM read_parquet([{', '.join(map(text, files))}], hive_partitioning = false)"


def _none(kinds: dict[str, str]) -> str:
    return f"SELECT {', '.join(f'CAST(NULL AS {kind}) AS {name_of(name)}' for name, kind in kinds.items())} WHERE false"


def _view(name: str, query: str) -> str:
    return f"CREATE OR REPLACE VIEW {name_of(name)} AS {query};"

