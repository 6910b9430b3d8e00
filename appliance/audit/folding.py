"""Folds repeated denials, so that a flood cannot push evidence out of the log. No I/O; time is given.

Invariants:
1. The first denial of its kind is recorded in full; every repetition is counted in exactly one summary. A record
   that stands for many, because who reported it had counted them (`count`), is as many repetitions.
2. Memory is bounded: at most `keys_per_host` kinds of one host, `keys` in all. Past that a host's further
   denials are one kind (`scope` "host"); past `keys` all further ones are one kind (`scope` "all"). Who and what such a
   kind is made of is counted by name, for the first names of each; the rest is counted together.
3. A kind is forgotten when it did not repeat for `seconds`; its next denial is recorded in full again.
4. An allow for the same host, caller, category and resource ends the kinds it contradicts: their summaries
   come before it.
5. What is counted is kept on disk: a kind is told by texts that can be stored (`columns.plain_record`).
6. What passed is never folded, also when it passed only because a policy is on trial (`would deny`): a policy
   is learned from all of it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import msgspec

from appliance.audit.columns import plain_record
from appliance.audit.record import Record, RuleReference, Severity

Key = tuple[str | int | None, ...]
_NAMES = 8
OTHERS = "(others)"  # no name of ROS, and no address, has a bracket
_LONGEST_NAME = 256
_ABOUT = ("call", "key", "node", "subgraph")  # fields of `detail` that say what a call was about


@dataclass(frozen=True)
class FoldSettings:
    """How repetitions are folded: a summary every `seconds`; 0 records every denial in full."""

    seconds: float = 10.0
    keys: int = 4096
    keys_per_host: int = 256
    events: frozenset[str] = frozenset({"connection refused", "limit exceeded", "malformed"})

    def __post_init__(self) -> None:
        if self.seconds < 0 or self.keys < 1 or self.keys_per_host < 1:
            raise ValueError("folding needs seconds >= 0 and at least one key, and one per host")


class FoldState(msgspec.Struct, kw_only=True):
    """The repetitions of one kind that are counted and not yet summarised; kept on disk against a crash."""

    scope: str
    event: str
    severity: Severity
    decision: str | None
    host: str | None
    caller_id: str | None
    category: str | None
    resource: str | None
    rule: RuleReference | None
    revision: int | None
    reason: str
    recorded_id: str
    count: int = 0
    first_id: str = ""
    last_id: str = ""
    first_time: int = 0
    last_time: int = 0
    about: dict[str, str] = {}
    tallies: dict[str, dict[str, int]] = {}


class Folder:
    """Decides of each record whether it is written in full or counted.

    `make_id` gives the summaries their ids; `now` is seconds of a clock that is never set back.
    """

    def __init__(self, settings: FoldSettings, make_id: Callable[[], str], clock: Callable[[], int]) -> None:
        self._settings = settings
        self._make_id = make_id
        self._clock = clock
        self._states: dict[Key, FoldState] = {}
        self._due: dict[Key, float] = {}
        self._per_host: dict[str | None, int] = {}
        self._per_subject: dict[Key, set[Key]] = {}
        self.touched: set[Key] = set()

    def __len__(self) -> int:
        return len(self._states)

    def state(self, key: Key) -> FoldState | None:
        """What is counted under a key now; None when there is nothing to keep."""
        state = self._states.get(key)
        return state if state is not None and state.count else None

    def offer(self, record: Record, now: float) -> Iterator[Record]:
        """The records to write for this one: itself, nothing (counted), or summaries and itself."""
        if not self._settings.seconds:
            yield record
        elif record.decision == "deny" or record.event in self._settings.events:
            if self._count(record, now):
                yield record
        else:
            if record.decision == "allow":
                yield from self._end_subject(_subject(_keepable(record)))
            yield record

    def _count(self, record: Record, now: float) -> bool:
        record = _keepable(record)
        key, scope = self._key(record)
        state = self._states.get(key)
        if state is None:
            self._states[key] = _new_state(record, scope)
            self._due[key] = now + self._settings.seconds
            self._per_host[record.host] = self._per_host.get(record.host, 0) + 1
            self._per_subject.setdefault(_subject(record), set()).add(key)
            return True
        if not state.count:
            state.first_id, state.first_time = record.id, record.time
        number = _stands_for(record)
        state.count += number
        state.last_id, state.last_time = record.id, record.time
        if scope != "kind":
            _tally(state.tallies, record, number)
        self.touched.add(key)
        return False

    def _key(self, record: Record) -> tuple[Key, str]:
        rule = record.rule
        where: Key = () if rule is None else (rule.section, rule.key, rule.file, rule.line)
        about = tuple(str(record.detail.get(name)) for name in _ABOUT)
        key: Key = (
            *_subject(record), record.event, record.decision, record.reason, record.revision, *about, *where,
        )  # fmt: skip
        if key in self._states:
            return key, "kind"
        if len(self._states) >= self._settings.keys:
            return ("all", record.event, record.decision), "all"
        if self._per_host.get(record.host, 0) >= self._settings.keys_per_host:
            return ("host", record.host, record.event, record.decision), "host"
        return key, "kind"

    def _end_subject(self, subject: Key) -> Iterator[Record]:
        for key in tuple(self._per_subject.get(subject, ())):
            yield from self._summary(key)
            self._forget(key)

    def expire(self, now: float) -> Iterator[Record]:
        """The summaries that are due; kinds that did not repeat are forgotten."""
        # Due times are in order of insertion: a kind that stays is put back at the end.
        while self._due:
            key = next(iter(self._due))
            if self._due[key] > now:
                return
            if self._states[key].count:
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
        for key in tuple(self._states):
            yield from self._summary(key)
            self._forget(key)

    def _forget(self, key: Key) -> None:
        state = self._states.pop(key)
        del self._due[key]
        self._per_host[state.host] -= 1
        if not self._per_host[state.host]:
            del self._per_host[state.host]
        subject = (state.host, state.caller_id, state.category, state.resource)
        keys = self._per_subject[subject]
        keys.discard(key)
        if not keys:
            del self._per_subject[subject]

    def _summary(self, key: Key) -> Iterator[Record]:
        state = self._states[key]
        if state.count:
            yield summary(state, self._make_id(), self._clock())
            state.count = 0
            state.tallies = {}
            self.touched.add(key)


def _keepable(record: Record) -> Record:
    """The record, in a form of which key and state can be stored."""
    rule = record.rule
    texts = [record.host, record.caller_id, record.category, record.resource, record.reason, record.event]
    texts += [str(record.detail[name]) for name in _ABOUT if name in record.detail]
    texts += [] if rule is None else [rule.section, rule.key, rule.file]
    try:
        for text in texts:
            if text is not None and not text.isascii():
                text.encode()
    except UnicodeEncodeError:
        return plain_record(record)
    return record


def _subject(record: Record) -> Key:
    return (record.host, record.caller_id, record.category, record.resource)


def _new_state(record: Record, scope: str) -> FoldState:
    return FoldState(
        scope=scope, event=record.event, severity=record.severity, decision=record.decision, host=record.host,
        caller_id=record.caller_id, category=record.category, resource=record.resource, rule=record.rule,
        revision=record.revision, reason=record.reason, recorded_id=record.id, about=_about(record),
    )  # fmt: skip


def _about(record: Record) -> dict[str, str]:
    """What the call was about, as far as its record says."""
    return {name: str(record.detail[name])[:_LONGEST_NAME] for name in _ABOUT if name in record.detail}


def _stands_for(record: Record) -> int:
    """How many denials this record is: its reporter may have counted repetitions itself (`count`)."""
    count = record.detail.get("count")
    return count if type(count) is int and count > 0 else 1


def _tally(tallies: dict[str, dict[str, int]], record: Record, number: int) -> None:
    """Count who it was and what was asked, by the first names of each."""
    named = {"hosts": record.host, "callers": record.caller_id, "resources": record.resource}
    for what, name in (named | {"calls": record.detail.get("call")}).items():
        if name:
            counts = tallies.setdefault(what, {})
            key = str(name)[:_LONGEST_NAME]
            key = key if key in counts or len(counts) < _NAMES else OTHERS
            counts[key] = counts.get(key, 0) + number


def summary(state: FoldState, record_id: str, time: int, *, recovered: bool = False) -> Record:
    """The record that stands for the repetitions counted in `state`."""
    detail: dict[str, object] = {
        "count": state.count, "of": state.event, "scope": state.scope, "recorded_id": state.recorded_id,
        "first_id": state.first_id, "last_id": state.last_id,
        "first_time": state.first_time, "last_time": state.last_time,
    }  # fmt: skip
    exact = state.scope == "kind"
    detail |= state.about if exact else state.tallies
    if recovered:
        detail["recovered"] = True
    return Record(
        id=record_id, time=time, event="denials folded", severity=state.severity, decision=state.decision,
        host=None if state.scope == "all" else state.host, caller_id=state.caller_id if exact else None,
        category=state.category if exact else None, resource=state.resource if exact else None,
        rule=state.rule if exact else None, revision=state.revision, reason=state.reason if exact else
        f"{state.count} further denials of many kinds", duration_us=None, detail=detail,
    )  # fmt: skip
