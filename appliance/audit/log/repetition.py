"""Define the kinds of folded records: the key that repetitions share, and the summary of a kind.

Texts from peers cannot create an unlimited number of kinds: only the plain words of an error are part of a key, not
the numbers, names and quotations that the peer chooses, and the key of an unknown host's kind has neither resource
nor caller.

A node's reads of parameters below its own name are one kind, whose summary lists all their names: a robot reads
thousands of them when it starts.
"""

import msgspec

from appliance.audit.log.columns import plain_record
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.base.counted import counted

Key = tuple[str | int | None, ...]
KIND, UNKNOWN, HOST, ALL_UNKNOWN, ALL = "kind", "unknown host", "host", "unknown hosts", "all"
"""The scopes of kinds; `ALL_UNKNOWN` and `ALL` cover many hosts."""

PARAMETERS = "parameters"
"""The field of a summary with the names of read parameters; none is left out."""

OTHERS = "(others)"  # no ROS name or address has a bracket
_NAMES = 8
_PARAMETERS, _PARAMETER_CHARACTERS = 256, 16 << 10  # the most in one list of read parameters
_LONGEST_NAME = 256
_LONGEST_KEY = 1024
ABOUT = ("call", "key", "node", "subgraph", "method", "status", "who", "monitor", "topics", "peer")
"""The fields of `detail` that identify a request."""
_KEY = ABOUT.index("key")


class FoldState(msgspec.Struct, kw_only=True):
    """The counted repetitions of one kind; stored on disk to survive a crash."""

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
    own: bool = False

    def count_in(self, record: AuditRecord) -> None:
        if not self.count:
            self.first_id, self.first_time = record.id, record.time
        number = repetitions(record.detail)
        self.count += number
        self.last_id, self.last_time = record.id, record.time
        if self.scope != KIND:
            named = {"hosts": record.host, "callers": record.caller_id, "resources": record.resource}
            for what, name in (named | {"calls": record.detail.get("call")}).items():
                self._tally(what, name, number)
        if self.own:
            read = self.tallies.setdefault(PARAMETERS, {})
            name = str(record.detail["key"])
            read[name] = read.get(name, 0) + number
        if self.scope != KIND or record.reason != self.reason:
            self._tally("reasons", record.reason, number)

    @property
    def is_full(self) -> bool:
        """Return whether the list of read parameters has no room for another one."""
        read = self.tallies.get(PARAMETERS, {})
        return len(read) >= _PARAMETERS or sum(map(len, read)) >= _PARAMETER_CHARACTERS

    def _tally(self, what: str, name: object, number: int) -> None:
        if name:
            counts = self.tallies.setdefault(what, {})
            key = str(name)[:_LONGEST_NAME]
            key = key if key in counts or len(counts) < _NAMES else OTHERS
            counts[key] = counts.get(key, 0) + number

    def reset(self) -> None:
        self.count = 0
        self.tallies = {}


def new_state(record: AuditRecord, scope: str) -> FoldState:
    own = scope == KIND and reads_its_own(record)
    known = {name: record.detail.get(name) for name in ABOUT if not (own and name == "key")}
    about = {name: str(value)[:_LONGEST_KEY] for name, value in known.items() if value is not None}
    return FoldState(
        scope=scope, event=record.event, severity=record.severity, decision=record.decision, host=record.host,
        caller_id=record.caller_id, category=record.category, resource=record.resource, rule=record.rule,
        revision=record.revision, reason=record.reason, recorded_id=record.id, about=about, folds=record.folds,
        own=own,
    )  # fmt: skip


def subject(record: AuditRecord) -> Key:
    """Return the request; a contrary decision about it ends a kind."""
    about = map(str, map(record.detail.get, ABOUT))
    return (record.host, record.caller_id, record.category, record.resource, *about)


def subject_of_own(record: AuditRecord) -> Key | None:
    """Return the subject of a node's reads of its own parameters; None for other requests."""
    if not _concerns_its_own(record):
        return None
    about = [str(record.detail.get(name)) for name in ABOUT]
    about[_KEY] = f"{record.caller_id}/"  # no parameter's name ends in a slash
    return (record.host, record.caller_id, record.category, record.resource, *about)


def reads_its_own(record: AuditRecord) -> bool:
    return record.folds and record.decision == "allow" and _concerns_its_own(record)


def _concerns_its_own(record: AuditRecord) -> bool:
    key, caller = record.detail.get("key"), record.caller_id
    return bool(caller) and type(key) is str and len(key) <= _LONGEST_NAME and key.startswith(f"{caller}/")


def subjects(record: AuditRecord) -> list[Key]:
    own = subject_of_own(record)
    return [subject(record)] if own is None else [subject(record), own]


def kind_of(record: AuditRecord) -> Key:
    if record.unknown:
        asked = (str(record.detail.get(name)) for name in ("call", "method", "status"))
        return (UNKNOWN, record.host, record.event, record.decision, *asked, _plain_words(record.reason))
    rule = record.rule
    where: Key = () if rule is None else (rule.section, rule.key, rule.file, rule.line)
    own = subject_of_own(record) if record.folds and record.decision == "allow" else None
    return (
        *(own or subject(record)),
        record.event,
        record.decision,
        record.revision,
        _plain_words(record.reason)
        if record.event != "decision" or record.decision == "ask"
        else record.reason,
        *where,
    )


def _plain_words(reason: str) -> str:
    return " ".join(word for word in reason[:_LONGEST_KEY].split() if word.isascii() and word.isalpha())


def storable(record: AuditRecord) -> AuditRecord:
    texts = [record.host, record.caller_id, record.category, record.resource, record.reason, record.event]
    texts += [str(record.detail[name]) for name in ABOUT if name in record.detail]
    try:
        msgspec.msgpack.encode((texts, record.rule))
    except UnicodeEncodeError:
        return plain_record(record)
    return record


def summary(state: FoldState, record_id: str, time: int, *, recovered: bool = False) -> AuditRecord:
    detail: dict[str, object] = {
        "count": state.count, "of": state.event, "scope": state.scope, "recorded_id": state.recorded_id,
        "first_id": state.first_id, "last_id": state.last_id,
        "first_time": state.first_time, "last_time": state.last_time,
    }  # fmt: skip
    exact = state.scope == KIND
    detail |= state.about if exact else {}
    detail |= state.tallies
    if recovered:
        detail["recovered"] = True
    passed = state.folds or state.decision == "ask"
    if exact:
        reason = state.reason
    elif passed:
        reason = counted(
            state.count,
            "further record of a host beyond its quota",
            "further records of a host beyond its quota",
        )
    elif state.scope == UNKNOWN and state.decision == "deny":
        reason = _denied_most(state)
    else:
        reason = counted(state.count, "further denial of many kinds", "further denials of many kinds")
    return AuditRecord(
        id=record_id, time=time, event="repetitions folded" if passed else "denials folded", severity=state.severity,
        decision=state.decision, host=None if state.scope in (ALL_UNKNOWN, ALL) else state.host,
        caller_id=state.caller_id if exact else None, category=state.category if exact else None,
        resource=state.resource if exact else None, rule=state.rule if exact else None, revision=state.revision,
        reason=reason,
        duration_us=None, detail=detail, unknown=state.scope in (UNKNOWN, ALL_UNKNOWN),
    )  # fmt: skip


def _denied_most(state: FoldState) -> str:
    """Return what an unknown host was denied most; all requests of a kind have the same call and category."""
    resources = state.tallies.get("resources", {})
    most = max(resources, key=lambda name: resources[name], default="")
    asked = " ".join(filter(None, (state.category, most))) or "requests"
    return f"{state.host} was denied {asked}{' and more' if len(resources) > 1 else ''}, {counted(state.count, 'time')}"


def repetitions(detail: dict[str, object]) -> int:
    count = detail.get("count")
    return count if type(count) is int and count > 0 else 1
