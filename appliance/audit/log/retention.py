"""Choose which old records to remove, and which of these to write again. No I/O.

A size limit keeps denials and alarms longer than other records: they are written again at the end of the log, with
their id and time, at most half of a step. Hosts take turns, so a flood from one host displaces no records of others.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec

from appliance.audit.log.columns import StoredColumns, from_columns
from appliance.audit.log.record import AuditRecord, Severity
from appliance.signing.log_proof import Removal

_UNKNOWN_HOSTS = "(unknown hosts)"
_DAY = 86_400_000_000_000
_Count = Annotated[int, msgspec.Meta(ge=0)]
_Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class Retention:
    """The limits of a log; by age, only records up to the sequence `collected()` are removed."""

    days: float | None = None
    size: int | None = None
    collected: Callable[[], int] = lambda: 1 << 63

    def __post_init__(self) -> None:
        if (self.days is not None and self.days <= 0) or (self.size is not None and self.size < 1 << 20):
            raise ValueError("retention needs more than 0 days and at least 1 MiB")

    def excess(self, size: int) -> str | None:
        too_large = self.size is not None and size > self.size
        return f"the log was larger than {self.size} bytes" if too_large else None

    def oldest_kept(self, now: int) -> int:
        """Return the time up to which records are too old (nanoseconds since the epoch); 0 without a limit."""
        return 0 if self.days is None else now - int(self.days * _DAY)


class RemovedRange(msgspec.Struct, frozen=True, omit_defaults=True):
    """The records that retention removes, and the hashes after which chain and checkpoints continue."""

    first_sequence: _Count
    last_sequence: _Count
    last_hash: _Hash
    first_time: int
    last_time: int
    last_checkpoint: _Count
    last_checkpoint_hash: _Hash
    limit: str = ""
    signature: str = ""

    def statement(self, log: str, limit: str) -> bytes:
        sequence, sealed = self.last_sequence, self.last_checkpoint_hash
        return Removal(log, self.last_checkpoint, sequence, self.last_hash, sealed, limit).text()


def as_kept(columns: StoredColumns, digest: bytes) -> AuditRecord:
    record = from_columns(columns)
    if "kept" in record.detail:
        return record
    place = {"sequence": columns.sequence, "hash": digest.hex()}
    return msgspec.structs.replace(record, detail=record.detail | {"kept": place})


def worth_keeping(evidence: Sequence[AuditRecord], removed: int) -> list[AuditRecord]:
    """Return at most half as many records as are removed. Hosts take turns; unknown hosts together have one.

    A host's alarms are chosen first, then its denials, then summaries.
    """
    by_host: dict[str, list[AuditRecord]] = {}
    for record in sorted(evidence, key=_rank):
        # Version 0.1.0 wrote `stranger`.
        who = _UNKNOWN_HOSTS if {"unknown_host", "stranger"} & record.detail.keys() else str(record.host)
        by_host.setdefault(who, []).append(record)
    turns = itertools.chain.from_iterable(itertools.zip_longest(*by_host.values()))
    chosen = {record.id for record in itertools.islice(filter(None, turns), removed // 2)}
    return [record for record in evidence if record.id in chosen]


def _rank(record: AuditRecord) -> int:
    if record.severity is Severity.ALARM:
        return 0
    return 2 if record.event == "denials folded" else 1
