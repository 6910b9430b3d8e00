"""Fold repetitions, so that a flood cannot push evidence out of the log or fill the disk. No I/O, no clock.

1. The first record of a kind is written in full; each repetition counts in one summary.
2. Memory is limited. In the pool of denials (`AUDIT_KINDS`), all unknown hosts together have a small quota; above a
   quota, further denials count as one kind. When the pool of reads (`AUDIT_READ_KINDS`) is full, decisions are
   written in full, because policies are learned from them.
3. An allow ends the denial kinds of the same host, caller and request, and a denial ends the allow kinds. Their
   summaries are written first, then the new record in full.
4. Counts are stored on disk, so the key of a kind has only storable texts (`storable`).
5. A node's reads of its own parameters are one kind. Its summary lists them, and is written early if the list is full.
6. A `would deny` of an audit-only policy is never folded.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.repetition import (
    ALL,
    ALL_UNKNOWN,
    HOST,
    KIND,
    UNKNOWN,
    FoldState,
    Key,
    kind_of,
    new_state,
    reads_its_own,
    storable,
    subjects,
    summary,
)
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from appliance.quotas.table import AUDIT_KINDS, AUDIT_READ_KINDS

_DENIALS = frozenset({"connection refused", "limit exceeded", "malformed", "rate limited"})
"""The events that are folded like denials."""

_FOLDED = frozenset({"deny", "ask"})
"""The decisions of which repetitions count in one summary."""

_Holder = tuple[str | None, QuotaClass]


@dataclass(frozen=True)
class FoldSettings:
    """A summary is written, or a kind without repetition forgotten, after `seconds`; 0 writes every record in full."""

    seconds: float = 10.0
    kinds: Bounds = AUDIT_KINDS.bounds
    read_kinds: Bounds = AUDIT_READ_KINDS.bounds

    def __post_init__(self) -> None:
        if self.seconds < 0:
            raise ValueError("folding needs seconds >= 0")


@dataclass(slots=True)
class _Kind:
    """A counted kind, and the subject whose contrary decision ends it."""

    state: FoldState
    pool: Pool[_Holder]
    holder: _Holder
    subject: Key | None


class RecordFolder:
    """Decides whether a record is written in full or only counted. `now` is in monotonic seconds."""

    def __init__(self, settings: FoldSettings, make_id: Callable[[], str], clock: Callable[[], int]) -> None:
        self._settings = settings
        self._make_id = make_id
        self._clock = clock
        self._kinds: dict[Key, _Kind] = {}
        self._coming: dict[Key, AuditRecord] = {}
        """The first denial of each new kind, before the owner offers it."""
        self._coming_as: dict[str, Key] = {}  # keys by record id
        self._due: dict[Key, float] = {}
        self._by_subject: dict[Key, set[Key]] = {}
        self._denials: Pool[_Holder] = Pool("kinds of denials", settings.kinds, _quota_class)
        self._reads: Pool[_Holder] = Pool("kinds of reads", settings.read_kinds, _quota_class)
        self.touched: set[Key] = set()

    def __len__(self) -> int:
        return len(self._kinds)

    def state(self, key: Key) -> FoldState | None:
        kind = self._kinds.get(key)
        return kind.state if kind is not None and kind.state.count else None

    def in_full(self, record: AuditRecord) -> str:
        """Return the id of the record that a denial repeats, or else its own id; empty for a collective kind."""
        if record.decision not in _FOLDED or not self._settings.seconds:
            return record.id
        plain = storable(record)
        key = narrow = kind_of(plain)
        if key not in self._coming:
            key, _ = self._denial_key(plain, self._coming_beside(plain))
        there = self._coming.get(key) or self._kinds.get(key)  # another thread adds to one, then removes
        first = there.state if isinstance(there, _Kind) else there or self._coming.setdefault(key, record)
        if first is record:
            self._coming_as[record.id] = key
            return record.id
        same = key == narrow and (first.caller_id, first.resource) == (record.caller_id, record.resource)
        known = first.id if isinstance(first, AuditRecord) else first.recorded_id
        return known if same else ""  # overflow kinds and kinds of unknown hosts are collective

    def _coming_beside(self, record: AuditRecord) -> int:
        host, quota_class = _holder(record)
        unknown = quota_class is QuotaClass.UNKNOWN
        waiting = list(self._coming.values())  # another thread removes from `_coming`
        return sum(other.unknown if unknown else other.host == host for other in waiting)

    def offer(self, record: AuditRecord, now: float) -> Iterator[AuditRecord]:
        if not self._settings.seconds:
            yield record
            return
        denial = record.decision in _FOLDED or record.event in _DENIALS
        # Most records contradict no kind: a robot is seldom denied anything.
        contrary = self._reads.total if denial else record.decision == "allow" and self._denials.total
        if not (denial or record.folds or contrary):
            yield record
            return
        plain = storable(record)
        if contrary:
            yield from self._end_contradicted(plain)
        counted = self._counted(plain, denial=denial, now=now) if denial or record.folds else None
        if counted is None:
            yield record
        elif self._kinds[counted].state.is_full:
            yield from self._summary(counted)
        key = self._coming_as.pop(record.id, None)
        if key is not None:
            del self._coming[key]  # now the record's kind, or its host's kind, exists

    def _counted(self, record: AuditRecord, *, denial: bool, now: float) -> Key | None:
        """Count a repetition and return its kind; None if the record is the first one of its kind, or of no kind."""
        key, scope = self._denial_key(record) if denial else self._passing_key(record)
        kind = self._kinds.get(key)
        if kind is not None:
            kind.state.count_in(record)
            self.touched.add(key)
            return key
        pool, holder = self._denials if denial else self._reads, _holder(record)
        if record.decision == "allow" and pool.refusal(holder):
            return None
        pool.charge(holder)
        about = subjects(record)[-1 if reads_its_own(record) else 0] if scope == KIND else None
        self._kinds[key] = _Kind(new_state(record, scope), pool, holder, about)
        self._due[key] = now + self._settings.seconds
        if about is not None:
            self._by_subject.setdefault(about, set()).add(key)
        return None

    def _denial_key(self, record: AuditRecord, coming: int = 0) -> tuple[Key, str]:
        key = kind_of(record)
        if key in self._kinds or not self._denials.refusal(_holder(record), 1 + coming):
            return key, UNKNOWN if record.unknown else KIND
        if record.unknown:
            return (ALL_UNKNOWN, record.event, record.decision), ALL_UNKNOWN
        host = (HOST, record.host, record.event, record.decision)
        # Each host gets its own kind, while the memory for kinds suffices.
        if host in self._kinds or len(self._kinds) < 2 * self._settings.kinds.whole:
            return host, HOST
        return (ALL, record.event, record.decision), ALL

    def _passing_key(self, record: AuditRecord) -> tuple[Key, str]:
        key = kind_of(record)
        if key in self._kinds or record.decision is not None or not self._reads.refusal(_holder(record)):
            return key, KIND
        return (HOST, record.host, record.event, record.decision), HOST

    def _end_contradicted(self, record: AuditRecord) -> Iterator[AuditRecord]:
        found = [key for about in subjects(record) for key in self._by_subject.get(about, ())]
        for key in found:
            if self._kinds[key].state.decision != record.decision:
                yield from self._summary(key)
                self._forget(key)

    def expire(self, now: float) -> Iterator[AuditRecord]:
        # Due times are in order of insertion, so a kind that stays is moved to the end.
        while self._due:
            key = next(iter(self._due))
            if self._due[key] > now:
                return
            if self._kinds[key].state.count:
                yield from self._summary(key)
                del self._due[key]
                self._due[key] = now + self._settings.seconds
            else:
                self._forget(key)

    def next_due(self) -> float | None:
        return next(iter(self._due.values()), None)

    def finish(self) -> Iterator[AuditRecord]:
        for key in tuple(self._kinds):
            yield from self._summary(key)
            self._forget(key)

    def _forget(self, key: Key) -> None:
        kind = self._kinds.pop(key)
        del self._due[key]
        kind.pool.give_back(kind.holder)
        if kind.subject is not None:
            keys = self._by_subject[kind.subject]
            keys.discard(key)
            if not keys:
                del self._by_subject[kind.subject]

    def _summary(self, key: Key) -> Iterator[AuditRecord]:
        state = self._kinds[key].state
        if state.count:
            yield summary(state, self._make_id(), self._clock())
            state.reset()
            self.touched.add(key)


def _holder(record: AuditRecord) -> _Holder:
    return record.host, QuotaClass.UNKNOWN if record.unknown else QuotaClass.NAMED


def _quota_class(holder: _Holder) -> QuotaClass:
    return holder[1]
