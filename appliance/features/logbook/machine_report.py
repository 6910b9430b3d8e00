"""Make the report of interventions from records and from what the running appliance says. No I/O.

A report is complete only as far as the log is: `gaps` has what limits it, and `verification` the last result of
`rosrv audit verify`.
"""

from collections.abc import Iterable, Mapping, Sequence

import msgspec

from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.features.logbook.interventions import Intervention

_SECOND = 1_000_000_000


class LastingState(msgspec.Struct, frozen=True, kw_only=True):
    """A state that lasted. An empty `until_utc`: it lasts; an empty `since_utc`: it began before the log."""

    what: str
    state: str
    since_utc: str
    until_utc: str
    by: str
    ended_by: str
    reason: str


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """An event that limits what the log proves."""

    time_utc: str
    event: str
    reason: str


class MachineInterface(msgspec.Struct, frozen=True, kw_only=True):
    """A way into the machine, whether commands come in by it, and what protects it."""

    name: str
    where: str
    commands: str
    protection: str


class VerificationResult(msgspec.Struct, frozen=True, kw_only=True):
    """The last stored result of `rosrv audit verify`, which is not part of the report's own work."""

    time_utc: str
    complete: bool
    records: int
    text: str


class MachineReport(msgspec.Struct, frozen=True, kw_only=True):
    """The report. `interfaces` and `rights` are those of now, or `live_reason` says why they are not known."""

    robot: str
    logs: list[str]
    since_utc: str
    until_utc: str
    made_utc: str
    version: str
    log_begins_utc: str
    interventions: list[Intervention]
    switched_off: list[LastingState]
    blocks: list[LastingState]
    software: list[LastingState]
    drivers: list[LastingState]
    interfaces: list[MachineInterface]
    rights: list[str]
    live_reason: str
    gaps: list[Gap]
    verification: VerificationResult | None


class Period(msgspec.Struct, frozen=True):
    """Nanoseconds since the epoch; `until` is exclusive."""

    since: int
    until: int

    def has(self, time: int) -> bool:
        return self.since <= time < self.until

    def meets(self, begin: int, end: int | None) -> bool:
        return begin < self.until and (end is None or end >= self.since)


class _Open(msgspec.Struct, frozen=True):
    state: str
    row: Intervention


def spans(
    rows: Iterable[Intervention], states: Mapping[str, str], period: Period, *, one: bool = False
) -> list[LastingState]:
    """Return what lasted within a period. `states` has the state that each event begins; an empty one ends it.

    With `one`, all rows are about the same thing, such as the version of the software.
    """
    opened: dict[str, _Open] = {}
    found: list[tuple[int, LastingState]] = []

    def close(key: str, row: Intervention | None) -> None:
        start = opened.pop(key, None)
        if start is not None and period.meets(start.row.time, row.time if row is not None else None):
            found.append((start.row.time, _span(start, row)))

    for row in rows:
        if row.event in states:
            key = "" if one else row.what
            close(key, row)
            state = states[row.event] or (row.after if one else "")
            if state:
                opened[key] = _Open(state, row)
    for key in list(opened):
        close(key, None)
    return [span for _, span in sorted(found, key=lambda pair: pair[0])]


def _span(start: _Open, end: Intervention | None) -> LastingState:
    return LastingState(
        what=start.row.what, state=start.state, since_utc=start.row.time_utc,
        until_utc="" if end is None else end.time_utc, by=start.row.who,
        ended_by="" if end is None else end.who or end.event, reason=start.row.reason,
    )  # fmt: skip


def driver_spans(rows: Iterable[Intervention], period: Period) -> list[LastingState]:
    """Return who drove each group of [Authority]; the appliance's end ends it, and that of its control process."""
    opened: dict[str, Intervention] = {}
    found: list[tuple[int, LastingState]] = []

    def close(group: str, end: Intervention) -> None:
        start = opened.pop(group, None)
        if start is not None and period.meets(start.time, end.time):
            found.append((start.time, _span(_Open(start.after, start), end)))

    for row in rows:
        if row.event in ENDS_OF_DRIVING:
            for group in list(opened):
                close(group, row)
        elif row.event == "authority handed over":
            close(row.what, row)
            if row.after and row.after != NO_HOST:
                opened[row.what] = row
    for start in opened.values():
        if period.meets(start.time, None):
            found.append((start.time, _span(_Open(start.after, start), None)))
    return [span for _, span in sorted(found, key=lambda pair: pair[0])]


ENDS_OF_DRIVING = ("appliance stopped", "appliance started", "process started")
"""Control begins without a holder of any group."""

NO_HOST = "nobody"
"""The holder of a free group in its record."""

OFF = {
    "monitor disabled": "off",
    "monitor in shadow mode": "shadow mode: watches only",
    "monitor enabled": "",
}
BLOCKED = {"host blocked": "blocked", "host unblocked": "", "host block ended": ""}
RUNS = {"appliance started": ""}


def gaps_of(entries: Iterable[LogEntry], period: Period) -> list[Gap]:
    return [
        Gap(time_utc=rfc3339(entry.record.time), event=entry.record.event, reason=entry.record.reason)
        for entry in entries
        if period.has(entry.record.time)
    ]


def pauses(rows: Sequence[Intervention], period: Period) -> list[Gap]:
    """Return the times without a running appliance: nothing was recorded, because nothing passed through it."""
    found: list[Gap] = []
    before: Intervention | None = None
    for row in rows:
        if row.event not in ("appliance started", "appliance stopped"):
            continue
        if row.event == "appliance started" and before is not None and period.meets(before.time, row.time):
            if before.event == "appliance stopped":
                seconds = (row.time - before.time) // _SECOND
                reason = f"shut down in order until {row.time_utc} ({seconds} s)"
            else:
                reason = f"no record of its end before the start at {row.time_utc}: a crash or a power cut"
            found.append(Gap(time_utc=before.time_utc, event="appliance not running", reason=reason))
        before = row
    if before is not None and before.event == "appliance stopped" and period.meets(before.time, None):
        reason = "shut down in order, and not started again since, as far as the log says"
        found.append(Gap(time_utc=before.time_utc, event="appliance not running", reason=reason))
    return found
