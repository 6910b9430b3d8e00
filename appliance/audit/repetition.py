"""Kinds of folded records: what makes two records repetitions of each other, and the record that stands for many.

No text of a peer's choice makes kinds without end:

1. A kind of a host that the policy names is told by event, decision, rule, what was asked of what, and the reason: of a
   decision, all of it, for it is ours; of what a peer got wrong the plain words, for numbers, names and what is quoted
   are the peer's. A host has so many kinds, and takes none from another.
2. A kind of a stranger is told by address, event, decision, call, and the plain words of the reason. All strangers
   together have a few.
3. What is over is one kind of its host, or one of all strangers. Reasons, callers and resources are counted by name,
   the first of each; the rest is counted together.
"""

from typing import Any

import msgspec

from appliance.audit.columns import plain_record
from appliance.audit.record import Record, RuleReference, Severity

Key = tuple[str | int | None, ...]
KIND, STRANGER, HOST, STRANGERS, ALL = "kind", "stranger", "host", "strangers", "all"
"""The scopes: what the records of a kind have in common. `STRANGERS` and `ALL` are of many hosts."""

OTHERS = "(others)"  # no name of ROS, and no address, has a bracket
_NAMES = 8
_LONGEST_NAME = 256
_LONGEST_KEY = 1024
ABOUT = ("call", "key", "node", "subgraph", "method", "status", "who", "monitor", "topics")
"""What a call was about, in `detail`."""


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
    folds: bool = False

    def count_in(self, record: Record) -> None:
        """One repetition more; it may stand for several."""
        if not self.count:
            self.first_id, self.first_time = record.id, record.time
        number = _stands_for(record)
        self.count += number
        self.last_id, self.last_time = record.id, record.time
        if self.scope != KIND:
            named = {"hosts": record.host, "callers": record.caller_id, "resources": record.resource}
            for what, name in (named | {"calls": record.detail.get("call")}).items():
                self._tally(what, name, number)
        if self.scope != KIND or record.reason != self.reason:
            self._tally("reasons", record.reason, number)

    def _tally(self, what: str, name: object, number: int) -> None:
        if name:
            counts = self.tallies.setdefault(what, {})
            key = str(name)[:_LONGEST_NAME]
            key = key if key in counts or len(counts) < _NAMES else OTHERS
            counts[key] = counts.get(key, 0) + number

    def begin_anew(self) -> None:
        """What was counted is summarised."""
        self.count = 0
        self.tallies = {}


def new_state(record: Record, scope: str) -> FoldState:
    """The state of a kind that begins with this record, which is written in full."""
    about = {name: str(record.detail[name])[:_LONGEST_KEY] for name in ABOUT if name in record.detail}
    return FoldState(
        scope=scope, event=record.event, severity=record.severity, decision=record.decision, host=record.host,
        caller_id=record.caller_id, category=record.category, resource=record.resource, rule=record.rule,
        revision=record.revision, reason=record.reason, recorded_id=record.id, about=about, tallies={},
        folds=record.folds,
    )  # fmt: skip


def subject(record: Record) -> Key:
    """Who asked what of what: what an answer of the other sort contradicts."""
    about = tuple(str(record.detail.get(name)) for name in ABOUT)
    return (record.host, record.caller_id, record.category, record.resource, *about)


def kind_of(record: Record) -> Key:
    """The key of the narrowest kind that a record is of."""
    if record.stranger:
        asked = (str(record.detail.get(name)) for name in ("call", "method", "status"))
        return (STRANGER, record.host, record.event, record.decision, *asked, _plain_words(record.reason))
    rule = record.rule
    where: Key = () if rule is None else (rule.section, rule.key, rule.file, rule.line)
    return (
        *subject(record),
        record.event,
        record.decision,
        record.revision,
        record.reason if record.event == "decision" else _plain_words(record.reason),
        *where,
    )


def _plain_words(reason: str) -> str:
    return " ".join(word for word in reason[:_LONGEST_KEY].split() if word.isascii() and word.isalpha())


def keepable(record: Record) -> Record:
    """The record, in a form of which key and state can be stored."""
    rule = record.rule
    texts = [record.host, record.caller_id, record.category, record.resource, record.reason, record.event]
    texts += [str(record.detail[name]) for name in ABOUT if name in record.detail]
    texts += [] if rule is None else [rule.section, rule.key, rule.file]
    try:
        for text in texts:
            if text is not None and not text.isascii():
                text.encode()
    except UnicodeEncodeError:
        return plain_record(record)
    return record


def summary(state: FoldState, record_id: str, time: int, *, recovered: bool = False) -> Record:
    """The record that stands for the repetitions counted in `state`."""
    detail: dict[str, Any] = {
        "count": state.count, "of": state.event, "scope": state.scope, "recorded_id": state.recorded_id,
        "first_id": state.first_id, "last_id": state.last_id,
        "first_time": state.first_time, "last_time": state.last_time,
    }  # fmt: skip
    exact = state.scope == KIND
    detail |= state.about if exact else {}
    detail |= state.tallies
    if recovered:
        detail["recovered"] = True
    passed = state.folds
    what = "further records of a host beyond its share" if passed else "further denials of many kinds"
    return Record(
        id=record_id, time=time, event="repetitions folded" if passed else "denials folded", severity=state.severity,
        decision=state.decision, host=None if state.scope in (STRANGERS, ALL) else state.host,
        caller_id=state.caller_id if exact else None, category=state.category if exact else None,
        resource=state.resource if exact else None, rule=state.rule if exact else None, revision=state.revision,
        reason=state.reason if exact else f"{state.count} {what}", duration_us=None, detail=detail,
        stranger=state.scope in (STRANGER, STRANGERS),
    )  # fmt: skip


def _stands_for(record: Record) -> int:
    """How many denials this record is: its reporter may have counted repetitions itself (`count`)."""
    count = record.detail.get("count")
    return count if type(count) is int and count > 0 else 1
