"""Which old records may go, and which of them are written again. No I/O.

Records go oldest first, in steps that do not hold up writing, each as far as a checkpoint seals them; where there is a
signer, one that it signed, and with its signature over the removal. Every step is itself a record, `records removed`,
with the hash that the chain goes on from.

For their age all records go. For the size of the log, reads go first and denials and alarms last: of what a step
removes, these are written again at the end of the log, with their id and time; at most half of what goes, so that the
log does shrink, and the hosts in turn, so that no flood of one host's pushes another's out.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from appliance.audit.chain import StoredColumns
from appliance.audit.columns import from_columns
from appliance.audit.record import Record, Severity

_OF_STRANGERS = "(strangers)"
_DAY = 86_400_000_000_000


@dataclass(frozen=True)
class Retention:
    """Keep records for `days` (None: for ever) and the log below `size` bytes (None: any)."""

    days: float | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        if (self.days is not None and self.days <= 0) or (self.size is not None and self.size < 1 << 20):
            raise ValueError("retention needs more than 0 days and at least 1 MiB")

    def excess(self, size: int) -> str | None:
        """Why the oldest records must go from a log of `size` bytes; None when it is not too large."""
        if self.size is None or size <= self.size:
            return None
        return f"the log was larger than {self.size} bytes"

    def oldest_kept(self, now: int) -> int:
        """Records before this time (nanoseconds since the epoch) are too old."""
        return 0 if self.days is None else now - int(self.days * _DAY)


def as_kept(columns: StoredColumns, digest: bytes) -> Record:
    """A record that is written again: as it was, with its first place in the log and its hash there."""
    record = from_columns(columns)
    if "kept" in record.detail:
        return record
    place = {"sequence": columns.sequence, "hash": digest.hex()}
    return msgspec.structs.replace(record, detail=record.detail | {"kept": place})


def worth_keeping(evidence: Sequence[Record], removed: int) -> list[Record]:
    """Of the denials and alarms among so many `removed` records those that are written again, in their order.

    Hosts take turns, and all strangers together are one; of one host's, alarms come before denials and those before
    summaries, the oldest first.
    """
    waiting: OrderedDict[str, list[Record]] = OrderedDict()
    for record in sorted(evidence, key=_rank):
        who = _OF_STRANGERS if record.detail.get("stranger") else str(record.host)
        waiting.setdefault(who, []).append(record)
    chosen: set[str] = set()
    while waiting and len(chosen) < removed // 2:
        who, records = waiting.popitem(last=False)
        chosen.add(records.pop(0).id)
        if records:
            waiting[who] = records
    return [record for record in evidence if record.id in chosen]


def _rank(record: Record) -> int:
    if record.severity is Severity.ALARM:
        return 0
    return 2 if record.event == "denials folded" else 1
