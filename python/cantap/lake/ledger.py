"""The ledger: the result for each input."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

#: All of it was read.
READ = "read"
#: It ends in the middle of something; everything before that is there.
CUT = "cut"
#: Places in it could not be read; the rest is there.
DAMAGED = "damaged"
#: It was read to its end, and is empty.
EMPTY = "empty"
#: It was read to its end and its frames are there, but no signals: its vehicle's databases cannot be used, or know none of its frames.
UNDECODED = "undecoded"
#: It is not a trace, or not in a vehicle's folder. It has no rows.
REFUSED = "refused"
#: The system did not deliver it, reading it took too long, or the process that read it died, twice. It has no rows.
FAILED = "failed"


@dataclass
class Entry:
    """The result for one input. It contains no times or machines: running the job again gives the same."""

    trace: str
    vehicle: str
    bytes: int
    state: str = READ
    #: A description of what is wrong; if there are several places, of the first.
    problem: str | None = None
    format: str | None = None
    #: Rows among the frames: frames, losses, bus errors, states.
    records: int = 0
    frames: int = 0
    #: Frames that are missing according to the trace; there may be more.
    lost: int = 0
    lost_at_least: bool = False
    bus_errors: int = 0
    #: Frames for which the databases have a message.
    decoded: int = 0
    #: Their share of all frames, from 0 to 1; `None` if the vehicle has no databases, or there are no frames.
    coverage: float | None = None
    #: Rows among the signals.
    signal_rows: int = 0
    #: Places that could not be read, and a description of the first.
    issues: int = 0
    faults: list[str] = field(default_factory=list)
    #: What is well-formed but not part of a CAN trace, by kind.
    left_out: dict[str, int] = field(default_factory=dict)
    #: What is not wrong but should be known, by kind.
    notes: dict[str, int] = field(default_factory=dict)
    #: What an MF4 file says about its measurement: device, session, author.
    properties: dict[str, str] = field(default_factory=dict)
    databases: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """For JSON and for Spark."""
        return asdict(self)


#: The same, as a Spark type.
DDL = (
    "trace string, vehicle string, bytes bigint, state string, problem string, format string, records bigint, frames bigint, "
    "lost bigint, lost_at_least boolean, bus_errors bigint, decoded bigint, coverage double, signal_rows bigint, issues bigint, "
    "faults array<string>, left_out map<string, bigint>, notes map<string, bigint>, properties map<string, string>, databases array<string>"
)
