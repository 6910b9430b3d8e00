"""Say which events are interventions in the machine's safety settings, and read them from the audit log. No I/O.

Each event of the log belongs to a subject here, or to `NO_INTERVENTION`: a test compares both with the list of events.
"""

from collections.abc import Iterable, Mapping

import msgspec

from appliance.audit.log.record_format import LogEntry, rfc3339

SUBJECTS: Mapping[str, tuple[str, ...]] = {
    "policy": ("policy loaded", "policy confirmed", "policy file refused"),
    "guards and monitors": (
        "specifications loaded", "specifications confirmed", "monitor enabled", "monitor disabled",
        "monitor in shadow mode", "monitor set", "monitor resumed", "monitor not built", "driver checked",
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
        "appliance started", "appliance stopped", "process started", "bundle in force", "bundle refused",
        "rest certificate replaced", "switchover ordered", "took over", "handed over",
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
        "decision", "registered", "adopted", "guard bypassed", "unregistered", "revoked", "node lost", "node returned",
        "replaced", "takeover",
        "approval used", "approval wanted", "authority asked", "authority refused", "motion not stopped",
        "motion stopped", "topics held", "monitor verdict", "message dropped", "message changed", "monitor fault",
        "monitor log", "monitor called", "monitor published", "shadow observed", "stop begun", "stop ended",
        "publication refused", "malformed", "connection opened", "connection closed", "connection refused",
        "limit exceeded", "rate limited", "denials folded", "repetitions folded", "door connected",
        "door disconnected", "door entry refused", "tunnel up", "tunnel moved", "tunnel down", "tunnel refused",
        "packets refused", "enrolment refused", "renewal refused", "sign-on refused", "order refused",
        # orders that were refused, and looks
        "policy refused", "specifications refused", "bundle metadata rejected", "switchover failed", "rest call",
        "topic looked into", "recording fetched", "recording read", "recording ordered", "recording closed",
        "recording missed", "ports checked",
        # the appliance itself
        "topics moved", "monitors restarted", "door failed", "adoption failed", "process failing", "probe failed",
        "probe passed", "reconciled", "checkpoint", "fleet not joined", "forwarding failed", "forwarding resumed",
        "forwarding gap", "disk has room", "clock synchronised", "protection forgotten", "certificate ends soon",
        "ended by the clock",
        "certificate ended",
    }
)  # fmt: skip

SUBJECT_OF = {event: subject for subject, events in SUBJECTS.items() for event in events}
_TEXT = "sha256"


class Intervention(msgspec.Struct, frozen=True, kw_only=True):
    """A change of a safety setting.

    `who` is a token, a person of single sign-on, `operator` for an order on the machine itself, or the appliance.
    `origin` is the address of the REST call, where one was found. `before` and `after` are values or versions;
    `sha256_before` and `sha256_after` those of a text, and `diff` the changed lines of it, if the log has them.
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


class Interventions:
    """Makes interventions of records in the order of the log, each with what was before it."""

    def __init__(self, appliance: str = "") -> None:
        self._appliance = appliance
        self._hashes: dict[str, str] = {}
        self._states: dict[str, str] = {}
        self._settings: Mapping[str, str] | None = None
        self.rows: list[Intervention] = []

    def add(self, entries: Iterable[LogEntry]) -> None:
        for entry in entries:
            self.rows.append(self._row(entry))

    def _row(self, entry: LogEntry) -> Intervention:
        record, detail = entry.record, entry.record.detail
        before, after = self._values(record.event, record.resource or "", detail)
        text = _hash_of(detail)
        key = record.event
        earlier = self._hashes.get(key, "") if text else ""
        if text:
            self._hashes[key] = text
        named = (detail.get(name) for name in ("name", "address", "token"))
        return Intervention(
            sequence=entry.sequence, id=record.id, time=record.time, time_utc=rfc3339(record.time),
            appliance=self._appliance, subject=SUBJECT_OF[record.event], event=record.event,
            what=str(record.resource or next(filter(None, named), None) or record.host or ""),
            who=str(detail.get("who") or ""), origin="", reason=record.reason, before=before, after=after,
            sha256_before=earlier, sha256_after=text,
            diff=[*map(str, detail.get("diff") or ()), *self._changed_settings(detail)],
        )  # fmt: skip

    def _values(self, event: str, what: str, detail: Mapping[str, object]) -> tuple[str, str]:
        match event:
            case "monitor set":
                return _pairs(detail.get("before")), _pairs(detail.get("values"))
            case "monitor enabled" | "monitor disabled" | "monitor in shadow mode":
                return self._state(f"monitor {what}", event.removeprefix("monitor "))
            case "authority handed over":
                return str(detail.get("earlier", "")), str(detail.get("holder", ""))
            case "host blocked" | "host unblocked" | "host block ended":
                address = str(detail.get("address", what))
                return self._state(f"host {address}", "blocked" if event == "host blocked" else "not blocked")
            case "appliance started":
                return self._state("version", str(detail.get("version", "")))
        return "", ""

    def _changed_settings(self, detail: Mapping[str, object]) -> list[str]:
        now, before = detail.get("configuration"), self._settings
        if not isinstance(now, Mapping):
            return []
        self._settings = now
        names = sorted(now.keys() | before.keys()) if before is not None else []
        return [
            f"appliance.yaml: {name} changed"
            for name in names
            if before and before.get(name) != now.get(name)
        ]

    def _state(self, key: str, now: str) -> tuple[str, str]:
        before = self._states.get(key, "")
        self._states[key] = now
        return before, now


def _hash_of(detail: Mapping[str, object]) -> str:
    found = detail.get(_TEXT)
    if isinstance(found, Mapping):  # one for each file of specifications
        return " ".join(f"{name}:{value}" for name, value in sorted(found.items()))
    return str(found or "")


def _pairs(values: object) -> str:
    return (
        ", ".join(f"{name} = {value}" for name, value in sorted(values.items()))
        if isinstance(values, Mapping)
        else ""
    )
