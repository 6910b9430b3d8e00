"""Say which events are interventions in the machine's safety settings, and read them from the audit log. No I/O.

Each event of the log belongs to a subject here, or to `NO_INTERVENTION`: a test compares both with the list of events.
Each intervention has an entry in `CHANGES`, which says where its record has the state before and after it: another test
compares the entries with the records that the appliance writes.
"""

from collections.abc import Iterator, Mapping
from string import Formatter
from typing import Any, NamedTuple

import msgspec

from appliance.audit.log.record_format import LogEntry, rfc3339

SUBJECTS: Mapping[str, tuple[str, ...]] = {
    "policy": ("policy loaded", "policy confirmed", "policy file refused", "rights changed"),
    "guards and monitors": (
        "specifications loaded", "specifications confirmed", "monitor enabled", "monitor disabled",
        "monitor in shadow mode", "monitor set", "monitor resumed", "monitor not built", "driver checked",
        "guard tested",
    ),
    "driving rights": ("authority handed over",),
    "approvals": ("approval given", "approval refused", "approval ended"),
    "blocks": ("host blocked", "host unblocked", "host block ended"),
    "doors": ("door added", "door removed", "door ticket made"),
    "tokens and sign-on": ("token added", "token revoked", "token rotated", "signed on", "signed off"),
    "hosts and tunnels": (
        "host enrolled", "host renewed", "host revoked", "host awaited", "host awaited no longer", "hosts reloaded",
        "host authority replaced",
    ),
    "alarms": ("alarm acknowledged", "alarm silenced", "alarm sounds again"),
    "software": (
        "appliance started", "appliance stopped", "process started", "bundle in force", "bundle ordered",
        "bundle refused", "rest certificate replaced", "switchover ordered", "took over", "handed over",
    ),
    "adoption of the robot's graph": ("graph adopted", "graph released"),
    "records": ("recording removed", "evidence exported", "log set aside"),
}  # fmt: skip
"""The events of each subject."""

GAPS = (
    "log begun", "records removed", "records lost", "log failed", "log replaced", "signature refused",
    "disk nearly full", "clock set forward", "clock set back", "clock not synchronised", "process died",
)  # fmt: skip
"""The events that limit what the log proves."""

NO_INTERVENTION = frozenset(
    {
        # what hosts and nodes did, and what the rules and monitors made of it
        "decision", "registered", "adopted", "guard bypassed", "guard loaded",
        "guard late", "heartbeat begun", "heartbeat ended", "unregistered", "revoked", "node lost",
        "node returned", "replaced", "takeover",
        "approval used", "approval wanted", "authority asked", "authority refused", "motion not stopped",
        "motion stopped", "topics held", "monitor verdict", "message dropped", "message changed", "monitor fault",
        "monitor log", "monitor called", "monitor published", "shadow observed", "stop begun", "stop ended",
        "publication refused", "malformed", "connection opened", "connection closed", "connection refused",
        "limit exceeded", "rate limited", "denials folded", "repetitions folded", "door connected",
        "door disconnected", "door entry refused", "tunnel up", "tunnel moved", "tunnel down", "tunnel refused",
        "definitions differ", "packets refused",
        "enrolment refused", "renewal refused", "sign-on refused", "order refused",
        # orders that were refused, and looks
        "policy refused", "specifications refused", "bundle metadata rejected", "switchover failed", "rest call",
        "topic looked into", "monitor looked into",
        "recording fetched", "recording read", "recording ordered", "recording closed",
        "recording missed", "ports checked",
        # the appliance itself
        "topics moved", "monitors restarted", "door failed", "adoption failed", "process failing", "probe failed",
        "firewall restored", "graph restored",
        "probe passed", "reconciled", "checkpoint", "fleet not joined", "forwarding failed", "forwarding resumed",
        "forwarding gap", "disk has room", "clock synchronised", "protection forgotten", "certificate ends soon",
        "ended by the clock", "state directory new",
        "certificate ended",
    }
)  # fmt: skip

_Detail = Mapping[str, Any]
SUBJECT_OF = {event: subject for subject, events in SUBJECTS.items() for event in events}

READ = (*SUBJECT_OF, *GAPS)
"""The events of which a report is made."""


class StateChange(NamedTuple):
    """The state before and after an intervention: texts with fields of the record's detail in braces.

    `text_before` and `text_after` name the fields with the SHA-256 of a text; its changed lines are in `diff`.
    """

    before: str
    after: str
    text_before: str = ""
    text_after: str = ""


def _text(before: str = "", after: str = "", *, earlier: str = "earlier_sha256") -> StateChange:
    return StateChange(before, after, earlier, "sha256")


NOTHING_CHANGED = StateChange("", "")
"""The order changed no setting: it looked, asked, exported, or was refused."""

CHANGES: Mapping[str, StateChange] = {
    "policy loaded": _text(),
    "policy confirmed": StateChange("in force until its time limit", "confirmed"),
    "policy file refused": NOTHING_CHANGED,
    "rights changed": NOTHING_CHANGED,  # the policy itself has the times; the reason names the rights
    "specifications loaded": _text(),
    "specifications confirmed": StateChange("in force until their time limit", "confirmed"),
    "monitor enabled": StateChange("{earlier}", "enabled"),
    "monitor disabled": StateChange("{earlier}", "disabled"),
    "monitor in shadow mode": StateChange("{earlier}", "in shadow mode"),
    "monitor set": StateChange("{before}", "{values}"),
    "monitor resumed": StateChange("holds its topics", "released"),
    "monitor not built": StateChange("loaded", "does nothing"),
    "driver checked": NOTHING_CHANGED,
    "guard tested": NOTHING_CHANGED,
    "authority handed over": StateChange("{earlier}", "{holder}"),
    "approval given": StateChange("{earlier}", "{now}"),
    "approval refused": StateChange("{earlier}", "{now}"),
    "approval ended": StateChange("{earlier}", "{now}"),
    "host blocked": StateChange("{earlier}", "blocked until {until}"),
    "host unblocked": StateChange("{earlier}", "not blocked"),
    "host block ended": StateChange("{earlier}", "not blocked"),
    "door added": StateChange("no door", "address {address}, port {port}, from {source}"),
    "door removed": StateChange("address {address}, port {port}, from {source}", "no door"),
    "door ticket made": StateChange("no ticket", "ticket {ticket} until {expires}"),
    "token added": StateChange("no token", "{role} until {expires}"),
    "token revoked": StateChange("{role} until {expires}", "revoked"),
    "token rotated": StateChange("{earlier} until {earlier_until}", "{id}, {role} until {expires}"),
    "signed on": StateChange("no session", "{role} until {expires}, groups of doors: {groups}"),
    "signed off": StateChange("{role}, groups of doors: {groups}", "no session"),
    "host enrolled": StateChange("not enrolled", "{address}, certificate {serial} until {expires}"),
    "host renewed": StateChange("certificate {replaced}", "certificate {serial} until {expires}"),
    "host revoked": StateChange("{address}, certificate {serial}", "revoked"),
    "host awaited": StateChange("no one-time token", "one-time token {id} for {address} until {expires}"),
    "host awaited no longer": StateChange("one-time token {id} for {address} until {expires}", "revoked"),
    "hosts reloaded": _text(),
    "host authority replaced": _text(),
    "alarm acknowledged": StateChange("{earlier}", "acknowledged"),
    "alarm silenced": StateChange("{earlier}", "silenced until {until}"),
    "alarm sounds again": StateChange("{earlier}", "not handled"),
    "appliance started": StateChange("", "{version}"),
    "appliance stopped": StateChange("runs", "stopped"),
    "process started": StateChange("ended unexpectedly", "runs"),
    "bundle in force": _text("{earlier}", "{bundle}"),
    "bundle ordered": NOTHING_CHANGED,
    "bundle refused": StateChange("{stays}", "{stays}"),
    "rest certificate replaced": _text(earlier="earlier"),
    "switchover ordered": NOTHING_CHANGED,
    "took over": StateChange("{other} serves, or none", "{appliance} serves"),
    "handed over": StateChange("{appliance} serves", "{to} may serve"),
    "graph adopted": StateChange("the robot's own master", "the appliance: {registrations} registrations"),
    "graph released": StateChange("the appliance", "the robot's own master: {given} registrations"),
    "recording removed": StateChange("SHA-256 {sha256}", "removed"),
    "evidence exported": NOTHING_CHANGED,
    "log set aside": StateChange("log {log} up to checkpoint {number}", "set aside"),
}
"""The state before and after each intervention. A start has the version before from the start before it."""

_LASTING = {
    **dict.fromkeys(("monitor enabled", "monitor disabled", "monitor in shadow mode"), "monitor"),
    **dict.fromkeys(("host blocked", "host unblocked", "host block ended"), "host"),
}
"""The kinds of states that last until the next record: records of earlier versions lack the state before."""

_TIMES = frozenset({"expires", "until", "earlier_until"})
_NONE = {"until": "an order ends it", "source": "any address"}


def fields_of(change: StateChange) -> set[str]:
    """Return the names of the detail's fields that a record needs for its change."""
    named = {name for text in change[:2] for _, name, _, _ in Formatter().parse(text) if name}
    return named | set(filter(None, change[2:]))


class Intervention(msgspec.Struct, frozen=True, kw_only=True):
    """A change of a safety setting.

    `who` is a token, a person of single sign-on, `operator` for an order on the machine itself, or the appliance.
    `origin` is the address of the REST call, where one was found. `before` and `after` are values or versions;
    `sha256_before` and `sha256_after` those of a text, and `diff` the changed lines of it, if the log has them.
    `names` are those that the addresses in these fields had then, by the records of enrolled hosts and doors.
    """

    sequence: int
    id: str
    time: int
    time_utc: str
    appliance: str
    subject: str
    event: str
    what: str
    who: str
    origin: str
    reason: str
    before: str
    after: str
    sha256_before: str
    sha256_after: str
    diff: list[str]
    names: dict[str, str] = {}


class ReadRow(NamedTuple):
    """An intervention, and what its record says about others.

    `off` are all monitors that are not in force from then on, with their states; None if the record does not list them.
    `loaded` are all monitors; None if the record does not list them. `settings` are those of `appliance.yaml` that
    a start lists, by section and name.
    """

    row: Intervention
    off: Mapping[str, str] | None
    loaded: frozenset[str] | None
    settings: Mapping[str, Mapping[str, str]] | None


class Interventions:
    """Makes interventions of records in order, each with what was before it.

    The records are of one appliance, or of both of a pair, which share their state.
    """

    def __init__(self) -> None:
        self.hosts: dict[str, str] = {}
        """The names of addresses after the last record."""
        self._states: dict[tuple[str, str], str] = {}
        self._starts: dict[str, _Detail] = {}

    def read(self, entry: LogEntry, appliance: str = "") -> ReadRow:
        """Return the intervention of a record, which must be of `SUBJECT_OF`."""
        record, detail = entry.record, entry.record.detail
        self._name(record.event, record.resource, detail)
        named = (detail.get(name) for name in ("name", "address", "token"))
        what = str(record.resource or next(filter(None, named), None) or record.host or "")
        change = CHANGES[record.event]
        before, after = (_fill(text, detail) for text in change[:2])
        sha256_before, sha256_after = (_hash(detail.get(name)) for name in change[2:])
        if change.text_after:
            sha256_before = self._earlier((record.event, what), sha256_before, sha256_after)
        elif record.event == "appliance started":
            before = self._earlier(("version", appliance), before, after)
        elif record.event in _LASTING:
            before = self._earlier((_LASTING[record.event], what), before, after)
        addresses = {what, before, after, record.host or ""} & self.hosts.keys()
        row = Intervention(
            sequence=entry.sequence, id=record.id, time=record.time, time_utc=rfc3339(record.time),
            appliance=appliance, subject=SUBJECT_OF[record.event], event=record.event, what=what,
            who=str(detail.get("who") or ""), origin="", reason=record.reason, before=before, after=after,
            sha256_before=sha256_before, sha256_after=sha256_after,
            diff=[*_changed_lines(change, detail), *self._changed_settings(detail, appliance)],
            names={address: self.hosts[address] for address in sorted(addresses)},
        )  # fmt: skip
        settings = detail.get("settings")
        sections: dict[str, Mapping[str, str]] | None = None
        if isinstance(settings, Mapping):
            sections = {name: _mapping(values) or {} for name, values in settings.items()}
        return ReadRow(row, _mapping(detail.get("off")), _names(detail), sections)

    def _earlier(self, key: tuple[str, str], before: str, after: str) -> str:
        """Return the state before, which records of earlier versions lack, and keep the state after."""
        earlier = before or self._states.get(key, "")
        self._states[key] = after
        return earlier

    def _name(self, event: str, resource: str | None, detail: _Detail) -> None:
        """Learn the name of an address. A revoked host and a removed door keep theirs: no other gets the address."""
        name = resource if event.startswith("door ") else detail.get("name")
        if event in _NAMING and name and detail.get("address"):
            self.hosts[str(detail["address"])] = str(name)

    def _changed_settings(self, detail: _Detail, appliance: str) -> Iterator[str]:
        now = detail.get("configuration")
        if not isinstance(now, Mapping):
            return
        earlier, self._starts[appliance] = self._starts.get(appliance), detail
        if earlier is None:
            return
        before = earlier["configuration"]
        for name in sorted(now.keys() | before.keys()):
            if before.get(name) != now.get(name):
                yield f"appliance.yaml: {name} changed"
                if "settings" in detail and "settings" in earlier:
                    yield from _changed_values(
                        name, *((one["settings"].get(name) or {}) for one in (earlier, detail))
                    )


_NAMING = frozenset({"host enrolled", "host awaited", "door added"})


def _changed_values(section: str, before: _Detail, after: _Detail) -> Iterator[str]:
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            yield f"-{section}.{name}: {before.get(name, 'the default')}"
            yield f"+{section}.{name}: {after.get(name, 'the default')}"


def _changed_lines(change: StateChange, detail: _Detail) -> Iterator[str]:
    yield from map(str, detail.get("diff") or ())
    if change.text_after and "diff" not in detail and "cut" in detail:
        yield "(too many changed lines for the record: compare the texts of both SHA-256)"


def _fill(text: str, detail: _Detail) -> str:
    """Return the text with the fields of a record, or an empty one if the record lacks one of them."""
    names = [name for _, name, _, _ in Formatter().parse(text) if name]
    if any(name not in detail for name in names):
        return ""
    return text.format_map({name: _words(name, detail[name]) for name in names})


def _words(name: str, value: object) -> str:
    if value is None:
        return _NONE.get(name, "none")
    if name in _TIMES and isinstance(value, int | float) and not isinstance(value, bool):
        return rfc3339(round(value * 1_000_000_000))[:19] + "Z"
    if isinstance(value, Mapping):
        return ", ".join(f"{one} = {_plain(found)}" for one, found in sorted(value.items()))
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value) or "none"


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _hash(value: object) -> str:
    if isinstance(value, Mapping):  # one for each file, in records of earlier versions
        return " ".join(f"{name}:{digest}" for name, digest in sorted(value.items()))
    return str(value or "")


def _mapping(value: object) -> Mapping[str, str] | None:
    return {str(name): str(state) for name, state in value.items()} if isinstance(value, Mapping) else None


def _names(detail: _Detail) -> frozenset[str] | None:
    found = detail.get("monitors")
    return frozenset(map(str, found)) if isinstance(found, list) and "cut" not in detail else None
