"""Many traces as tables of Parquet, decoded once each, whatever is added later: `cantap-lake`, or `ingest`.

A trace is known by its content: one that was read is not read again, under whatever name it comes. Its rows become visible when its entry in
the ledger is written, which names its files; what an interrupted run left behind is not seen, and is replaced by the next one.
"""

from .compaction import Compacted, compact, vacuum
from .ingest import Summary, ingest
from .store import Store

__all__ = ["Compacted", "Store", "Summary", "compact", "ingest", "vacuum"]
