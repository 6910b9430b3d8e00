"""Folds repetitions, so that no flood pushes evidence out of the log or fills the disk. No I/O; time is given.

What is folded are denials, what peers get wrong, and what passed and only reads, or is of a host that is beyond its
budget (`Record.folds`). Invariants:

1. The first of its kind is recorded in full; every repetition is counted in exactly one summary. A record
   that stands for many, because who reported it had counted them (`count`), is as many repetitions.
2. Memory is bounded, and shared: kinds of denials are a pool (`AUDIT_KINDS`) in which strangers together have a small
   share, so nothing that strangers do takes a kind from a host that the policy names. Past its share a host's further
   denials are one kind of that host, strangers' one kind of all of them. Kinds of what passed are a pool of their own
   (`AUDIT_READ_KINDS`); past it a decision is recorded in full, because a policy is learned from all of them.
3. A kind is forgotten when it did not repeat for `seconds`; its next record is in full again.
4. An allow for the same host, caller and request ends the denials it contradicts, and a denial what passed: their
   summaries come before it, and it is in full.
5. What is counted is kept on disk: a kind is told by texts that can be stored (`kinds.keepable`).
6. What passed only because a policy is on trial (`would deny`) is never folded.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from appliance.audit.record import Record
from appliance.audit.repetition import (
    ALL,
    HOST,
    KIND,
    STRANGER,
    STRANGERS,
    FoldState,
    Key,
    keepable,
    kind_of,
    new_state,
    subject,
    summary,
)
from appliance.quotas.pool import Bounds, Pool, Standing
from appliance.quotas.table import AUDIT_KINDS, AUDIT_READ_KINDS

_Holder = tuple[str | None, Standing]


@dataclass(frozen=True)
class FoldSettings:
    """How repetitions are folded: a summary every `seconds`; 0 records everything in full."""

    seconds: float = 10.0
    kinds: Bounds = AUDIT_KINDS.bounds
    read_kinds: Bounds = AUDIT_READ_KINDS.bounds
    events: frozenset[str] = field(
        default=frozenset({"connection refused", "limit exceeded", "malformed", "rate limited"})
    )

    def __post_init__(self) -> None:
        if self.seconds < 0:
            raise ValueError("folding needs seconds >= 0")


@dataclass(slots=True)
class _Kind:
    """A kind that is counted: its state, its place in a pool, and the subject that an answer to the contrary ends."""

    state: FoldState
    pool: Pool[_Holder]
    holder: _Holder
    subject: Key | None


class Folder:
    """Decides of each record whether it is written in full or counted.

    `make_id` gives the summaries their ids; `now` is seconds of a clock that is never set back.
    """

    def __init__(self, settings: FoldSettings, make_id: Callable[[], str], clock: Callable[[], int]) -> None:
        self._settings = settings
        self._make_id = make_id
        self._clock = clock
        self._kinds: dict[Key, _Kind] = {}
        self._coming: dict[Key, Record] = {}
        """Denials that the owner will offer, by their kind; of each the first, where it was not there yet."""
        self._coming_as: dict[str, Key] = {}  # by their ids
        self._due: dict[Key, float] = {}
        self._by_subject: dict[Key, set[Key]] = {}
        self._denials: Pool[_Holder] = Pool("kinds of denials", settings.kinds, _standing)
        self._reads: Pool[_Holder] = Pool("kinds of reads", settings.read_kinds, _standing)
        self.touched: set[Key] = set()

    def __len__(self) -> int:
        return len(self._kinds)

    def state(self, key: Key) -> FoldState | None:
        """What is counted under a key now; None when there is nothing to keep."""
        kind = self._kinds.get(key)
        return kind.state if kind is not None and kind.state.count else None

    def in_full(self, record: Record) -> str:
        """The id of the record in full that a denial repeats; else its own, or none if it is counted among others.

        By the owner, before it offers the record. What was not offered yet (the log gathers) is remembered, so that a
        repetition in the same moment finds it.
        """
        if record.decision != "deny" or not self._settings.seconds:
            return record.id
        plain = keepable(record)
        key = narrow = kind_of(plain)
        if key not in self._coming:
            key, _ = self._denial_key(plain, self._coming_beside(plain))
        kind = self._kinds.get(key)
        first: Record | FoldState = self._coming.setdefault(key, record) if kind is None else kind.state
        if first is record:
            self._coming_as[record.id] = key
            return record.id
        same = key == narrow and (first.caller_id, first.resource) == (record.caller_id, record.resource)
        known = first.id if isinstance(first, Record) else first.recorded_id
        return known if same else ""  # what is over, and a kind of a stranger, is of many things

    def _coming_beside(self, record: Record) -> int:
        """How many kinds will be of the share that a denial is charged to, and are not there yet."""
        host, standing = _holder(record)
        strangers = standing is Standing.STRANGER
        waiting = list(self._coming.values())  # another thread takes from it
        return sum(other.stranger if strangers else other.host == host for other in waiting)

    def offer(self, record: Record, now: float) -> Iterator[Record]:
        """The records to write for this one: itself, nothing (counted), or summaries and itself."""
        if not self._settings.seconds:
            yield record
            return
        denial = record.decision == "deny" or record.event in self._settings.events
        if not (denial or record.folds or (record.decision == "allow" and self._by_subject)):
            yield record
            return
        plain = keepable(record)
        if denial or record.decision == "allow":
            yield from self._end_contradicted(plain)
        if not (denial or record.folds) or not self._counted(plain, denial=denial, now=now):
            yield record
        key = self._coming_as.pop(record.id, None)
        if key is not None:
            del self._coming[key]  # from now on its kind is there, or that of its host

    def _counted(self, record: Record, *, denial: bool, now: float) -> bool:
        key, scope = self._denial_key(record) if denial else self._passing_key(record)
        kind = self._kinds.get(key)
        if kind is not None:
            kind.state.count_in(record)
            self.touched.add(key)
            return True
        pool, holder = self._denials if denial else self._reads, _holder(record)
        if record.decision == "allow" and pool.refusal(holder):
            return False
        pool.charge(holder)
        about = subject(record) if scope == KIND else None
        self._kinds[key] = _Kind(new_state(record, scope), pool, holder, about)
        self._due[key] = now + self._settings.seconds
        if about is not None:
            self._by_subject.setdefault(about, set()).add(key)
        return False

    def _denial_key(self, record: Record, coming: int = 0) -> tuple[Key, str]:
        """The kind that a denial is counted in, and its scope, when `coming` kinds more are of its share."""
        key = kind_of(record)
        if key in self._kinds or not self._denials.refusal(_holder(record), 1 + coming):
            return key, STRANGER if record.stranger else KIND
        if record.stranger:
            return (STRANGERS, record.event, record.decision), STRANGERS
        host = (HOST, record.host, record.event, record.decision)
        # A host has a line of its own however many kinds others have; there are more hosts than memory, too.
        if host in self._kinds or len(self._kinds) < 2 * self._settings.kinds.whole:
            return host, HOST
        return (ALL, record.event, record.decision), ALL

    def _passing_key(self, record: Record) -> tuple[Key, str]:
        key = kind_of(record)
        if key in self._kinds or record.decision is not None or not self._reads.refusal(_holder(record)):
            return key, KIND
        return (HOST, record.host, record.event, record.decision), HOST

    def _end_contradicted(self, record: Record) -> Iterator[Record]:
        for key in tuple(self._by_subject.get(subject(record), ())):
            if self._kinds[key].state.decision != record.decision:
                yield from self._summary(key)
                self._forget(key)

    def expire(self, now: float) -> Iterator[Record]:
        """The summaries that are due; kinds that did not repeat are forgotten."""
        # Due times are in order of insertion: a kind that stays is put back at the end.
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
        """When `expire` has something to do next."""
        return next(iter(self._due.values()), None)

    def finish(self) -> Iterator[Record]:
        """All summaries, at the end."""
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

    def _summary(self, key: Key) -> Iterator[Record]:
        state = self._kinds[key].state
        if state.count:
            yield summary(state, self._make_id(), self._clock())
            state.begin_anew()
            self.touched.add(key)


def _holder(record: Record) -> _Holder:
    """Whose share a kind is of; what is nobody's is counted like a named host's."""
    return record.host, Standing.STRANGER if record.stranger else Standing.NAMED


def _standing(holder: _Holder) -> Standing:
    return holder[1]
