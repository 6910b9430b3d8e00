"""Make the report of interventions from records and from what the running appliance says. No I/O.

A report is complete only as far as the log is: `gaps` has what limits it, and `verification` the last result of
`rosrv audit verify`.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import NamedTuple

import msgspec

from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.proof.chain_findings import VerificationResult
from appliance.formats.interventions import GAPS, Intervention, Interventions, ReadRow

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
    appliance: str = ""
    names: dict[str, str] = {}


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """An event that limits what the log proves."""

    time_utc: str
    event: str
    reason: str
    appliance: str = ""


class MachineInterface(msgspec.Struct, frozen=True, kw_only=True):
    """A way into the machine, whether commands come in by it, and what protects it."""

    name: str
    where: str
    commands: str
    protection: str


class ReportedLog(msgspec.Struct, frozen=True, kw_only=True):
    """An audit log of which the report is made, from its first record to `last`, and its last verification."""

    name: str
    id: str
    begins_utc: str
    last: int
    verification: VerificationResult | None


class MachineRight(msgspec.Struct, frozen=True, kw_only=True):
    """A right on the machine now, its holders, and the rule or role that gives it."""

    what: str
    who: str
    by: str


class MachineReport(msgspec.Struct, frozen=True, kw_only=True):
    """The report. `interfaces` and `rights` are those of now, or `live_reason` says why they are not known.

    `verify` is the command that verifies the logs.
    """

    robot: str
    logs: list[ReportedLog]
    since_utc: str
    until_utc: str
    made_utc: str
    version: str
    verify: str
    interventions: list[Intervention]
    switched_off: list[LastingState]
    blocks: list[LastingState]
    software: list[LastingState]
    drivers: list[LastingState]
    interfaces: list[MachineInterface]
    rights: list[MachineRight]
    live_reason: str
    gaps: list[Gap]


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


class LastingStates:
    """The states that lasted within a period. `states` has the state that each event begins; an empty one ends it.

    `key` says of which thing a row is the state, by default of the one that it names.
    """

    def __init__(
        self,
        states: Mapping[str, str],
        period: Period,
        key: Callable[[Intervention], str] = lambda row: row.what,
    ) -> None:
        self._states = states
        self._period = period
        self._key = key
        self._opened: dict[str, _Open] = {}
        self._found: list[tuple[int, LastingState]] = []

    def add(self, read: ReadRow) -> None:
        row = read.row
        if row.event in self._states:
            self._begin(self._key(row), self._states[row.event], row)

    def _begin(self, key: str, state: str, row: Intervention) -> None:
        self._close(key, row)
        if state:
            self._opened[key] = _Open(state, row)

    def _close(self, key: str, row: Intervention | None) -> None:
        start = self._opened.pop(key, None)
        if start is not None and self._period.meets(start.row.time, row.time if row is not None else None):
            self._found.append((start.row.time, _span(start, row, key)))

    def result(self) -> list[LastingState]:
        """Return the states by their begin. States that have not ended are open."""
        for key in list(self._opened):
            self._close(key, None)
        return [span for _, span in sorted(self._found, key=lambda pair: pair[0])]


class MonitorsOff(LastingStates):
    """The monitors that were not in force. One that a load or a start does not list was removed, so its state ends."""

    def __init__(self, period: Period) -> None:
        super().__init__(OFF, period)

    def add(self, read: ReadRow) -> None:
        super().add(read)
        if read.off is None and read.loaded is None:
            return
        for name, start in list(self._opened.items()):
            if (read.off is not None and name not in read.off) or (
                read.loaded is not None and name not in read.loaded
            ):
                self._close(name, read.row)
            elif read.off is not None and read.off[name] != start.state:
                self._begin(name, read.off[name], read.row)
        for name, state in (read.off or {}).items():
            if name not in self._opened:
                self._begin(name, state, read.row)


class Versions(LastingStates):
    """The versions of the software that ran, for each appliance."""

    def __init__(self, period: Period) -> None:
        super().__init__({"appliance started": ""}, period, lambda row: row.appliance or "this appliance")

    def add(self, read: ReadRow) -> None:
        if read.row.event == "appliance started":
            self._begin(self._key(read.row), read.row.after, read.row)


class Drivers(LastingStates):
    """The drivers of each group of [Authority]; the end of control, and of the appliance, ends their time."""

    def __init__(self, period: Period) -> None:
        super().__init__({}, period)

    def add(self, read: ReadRow) -> None:
        row = read.row
        if row.event in ENDS_OF_DRIVING:
            for group in list(self._opened):
                self._close(group, row)
        elif row.event == "authority handed over":
            self._begin(row.what, "" if row.after == NO_HOST else row.after, row)


def _span(start: _Open, end: Intervention | None, what: str) -> LastingState:
    return LastingState(
        what=what, state=start.state, since_utc=start.row.time_utc,
        until_utc="" if end is None else end.time_utc, by=start.row.who,
        ended_by="" if end is None else end.who or end.event, reason=start.row.reason,
        appliance=start.row.appliance, names=start.row.names,
    )  # fmt: skip


ENDS_OF_DRIVING = ("appliance stopped", "appliance started", "process started", "took over")
"""Control begins without a holder of any group."""

NO_HOST = "nobody"
"""The holder of a free group in its record."""

OFF = {"monitor disabled": "disabled", "monitor in shadow mode": "in shadow mode", "monitor enabled": ""}
BLOCKED = {"host blocked": "blocked", "host unblocked": "", "host block ended": ""}


def gap_of(entry: LogEntry, appliance: str) -> Gap:
    record = entry.record
    return Gap(time_utc=rfc3339(record.time), event=record.event, reason=record.reason, appliance=appliance)


class Pauses:
    """The times without a running appliance: nothing was recorded, because nothing passed through it."""

    def __init__(self, period: Period) -> None:
        self._period = period
        self._before: Intervention | None = None
        self._found: list[Gap] = []

    def add(self, read: ReadRow) -> None:
        row, before = read.row, self._before
        if row.event not in _RUNS:
            return
        self._before = row
        if (
            row.event == "appliance stopped"
            or before is None
            or not self._period.meets(before.time, row.time)
        ):
            return
        if before.event == "appliance stopped":
            seconds = (row.time - before.time) // _SECOND
            self._note(before, f"shut down in order until {row.time_utc} ({seconds} s)")
        else:
            self._note(
                before, f"no record of its end before the start at {row.time_utc}: a crash or a power cut"
            )

    def _note(self, row: Intervention, reason: str) -> None:
        gap = Gap(
            time_utc=row.time_utc, event="appliance not running", reason=reason, appliance=row.appliance
        )
        self._found.append(gap)

    def result(self) -> list[Gap]:
        before = self._before
        if (
            before is not None
            and before.event == "appliance stopped"
            and self._period.meets(before.time, None)
        ):
            self._note(before, "shut down in order, and not started again since, as far as the log says")
            self._before = None
        return self._found


_RUNS = ("appliance started", "appliance stopped")


class NamedEntry(NamedTuple):
    """A record, and the appliance or robot that wrote it; its name is empty if there is only one."""

    name: str
    entry: LogEntry


def merge(logs: Mapping[str, Iterable[LogEntry]]) -> Iterator[NamedEntry]:
    """Yield the records of several logs by time, each once: a log has the order of its records, whatever its clock did.

    Retention by size writes some old records again at the end of a log, with their id, and a machine that was cloned
    has the records of its copy.
    """
    seen: set[str] = set()
    for _, name, entry in heapq.merge(*(_timed(name, log) for name, log in logs.items()), key=itemgetter(0)):
        if entry.record.id not in seen:
            seen.add(entry.record.id)
            yield NamedEntry(name, entry)


def _timed(name: str, entries: Iterable[LogEntry]) -> Iterator[tuple[int, str, LogEntry]]:
    latest = 0
    for entry in entries:
        if "kept" not in entry.record.detail:
            latest = max(latest, entry.record.time)
        yield latest, name, entry


class Reading(msgspec.Struct, kw_only=True):
    """The records of a machine, read for a period.

    `places` are the address and port of each door at the end of the log; `settings` are those of the last start that
    listed them, by section and name; None without one.
    """

    places: dict[str, str] = {}
    settings: Mapping[str, Mapping[str, str]] | None = None
    interventions: list[Intervention] = []
    switched_off: list[LastingState] = []
    blocks: list[LastingState] = []
    software: list[LastingState] = []
    drivers: list[LastingState] = []
    gaps: list[Gap] = []


def read_records(
    entries: Iterable[NamedEntry],
    period: Period,
    with_origin: Callable[[Intervention], Intervention] = lambda row: row,
) -> Reading:
    """Read the records of `READ`, of an appliance or of a pair, in order. Only what concerns the period is kept."""
    found, interventions = Reading(), Interventions()
    off, blocks, software = MonitorsOff(period), LastingStates(BLOCKED, period), Versions(period)
    drivers, stops = Drivers(period), Pauses(period)
    for name, entry in entries:
        if entry.record.event in GAPS:
            if period.has(entry.record.time):
                found.gaps.append(gap_of(entry, name))
            continue
        read = interventions.read(entry, name)
        for one in (off, blocks, software, drivers, stops):
            one.add(read)
        if read.row.event == "door added":
            found.places[read.row.what] = read.row.after
        elif read.row.event == "door removed":
            found.places.pop(read.row.what, None)
        if read.settings is not None:
            found.settings = read.settings
        if period.has(read.row.time):
            found.interventions.append(_with_name(with_origin(read.row), interventions.hosts))
    found.switched_off, found.blocks, found.software, found.drivers = (
        one.result() for one in (off, blocks, software, drivers)
    )
    found.gaps = sorted([*found.gaps, *stops.result()], key=lambda gap: gap.time_utc)
    return found


def _with_name(row: Intervention, hosts: Mapping[str, str]) -> Intervention:
    if row.origin not in hosts:
        return row
    return msgspec.structs.replace(row, names=row.names | {row.origin: hosts[row.origin]})
