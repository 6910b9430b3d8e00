"""Keep how late guards have acted, over restarts, and whether the heartbeat is on."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import NamedTuple

import msgspec

from appliance.base import clock
from appliance.base.counted import counted
from appliance.configuration.settings import Relay
from appliance.features.guards.guard_answers import GuardTimes
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

LATELY_SECONDS = 60.0
"""For which a delay beyond the limit is an alarm; then its guard's next one is recorded again."""
_SETTING = "guard times"
_SAVED_SECONDS = 60.0
_REPORTED_SECONDS = 2.0  # relays report once a second: a longer pause was not measured


class _Kept(NamedTuple):
    """The times, and the last report of each guard's relay, which may outlive control: timed, late and latest."""

    times: dict[str, GuardTimes]
    counted: dict[str, tuple[int, int, float]]


class GuardFitness:
    """The times of guards since they were first measured with the present limit."""

    def __init__(
        self, monitors: SpecificationManager, relay: Relay, relays: int, trail: AuditTrail, store: StateStore
    ) -> None:
        self._monitors, self._trail, self._store = monitors, trail, store
        self._limit, self._relays = relay.late / 1e3, relays
        self._wanted = bool(relay.heartbeat or relay.heartbeat_line)
        self._beats = False
        self._late: dict[
            str, list[tuple[float, int, float]]
        ] = {}  # of the last minute: when, how many, how late
        self._saved = clock.now()
        kept = _Kept({}, {})
        with suppress(ValueError):  # an unreadable row begins again
            kept = msgspec.json.decode(store.settings().get(_SETTING, "[{}, {}]"), type=_Kept)
        self.times, self._counted = kept
        self._grown = dict.fromkeys(self._counted, self._saved)  # when the report last grew

    def look(self, guards: Iterable[str]) -> None:
        names, now = [*guards], clock.now()
        found = {name: self._add(name, now) for name in names}
        self.times = {name: times for name, times in found.items() if times.timed}
        self._counted = {name: row for name, row in self._counted.items() if name in found}
        self._grown = {name: at for name, at in self._grown.items() if name in found}
        self._late = {
            name: rows
            for name in names
            if (rows := [row for row in self._late.get(name, ()) if now - row[0] < LATELY_SECONDS])
        }
        if now - self._saved >= _SAVED_SECONDS:
            self.save()
        why = self.heartbeat
        if why is not None and (why == "") is not self._beats:
            self._beats = why == ""
            self._record_heartbeat(why)

    def save(self) -> None:
        self._saved = clock.now()
        with suppress(StoreError):  # a full disk has its own alarm; the next minute tries again
            self._store.save_setting(_SETTING, msgspec.json.encode(_Kept(self.times, self._counted)).decode())

    @property
    def late(self) -> Mapping[str, str]:
        """The delays of the last minute in words, by guard."""
        return {name: self._in_words(rows) for name, rows in self._late.items()}

    @property
    def heartbeat(self) -> str | None:
        """Why the heartbeat is off, or an empty text; null if none is set."""
        if not self._wanted:
            return None
        rollout = self._monitors.rollout
        reasons = [rollout.unfit.get(relay, "a relay process is starting") for relay in range(self._relays)]
        if not any(rollout.acting.values()):
            reasons.append("no guard is in force")
        return next(filter(None, reasons), "")

    def _add(self, name: str, now: float) -> GuardTimes:
        times = self.times.get(name)
        if times is None or times.limit != self._limit:
            times = GuardTimes(clock.wall(), 0.0, 0, 0, 0.0, self._limit)
        row = self._monitors.rollout.rows.get(name)
        if row is None or row.shadow:
            return times
        before, report = self._counted.get(name, (0, 0, 0.0)), (row.timed, row.late, row.latest)
        if row.timed == before[0]:
            return times
        if any(new < old for new, old in zip(report, before, strict=True)):
            before = 0, 0, 0.0  # another relay process, or the guard began again
        more, beyond = row.timed - before[0], row.late - before[1]
        grown = self._grown.get(name, now)
        self._counted[name], self._grown[name] = report, now
        if beyond:
            rows = self._late.setdefault(name, [])
            rows.append((now, beyond, row.latest))
            if len(rows) == 1:
                self._record(name)
        return GuardTimes(
            times.since,
            times.seconds + min(now - grown, _REPORTED_SECONDS),
            times.timed + more,
            times.late + beyond,
            max(times.latest, row.latest),
            self._limit,
        )

    def _in_words(self, rows: Iterable[tuple[float, int, float]]) -> str:
        found = [*rows]
        latest, times = max(row[2] for row in found), sum(row[1] for row in found)
        limit = f"{self._limit * 1e3:g} ms"
        return (
            f"acted late {counted(times, 'time')} in the last minute (limit {limit}, longest since its relay began"
            f" {latest * 1e3:.1f} ms)"
        )

    def _record(self, name: str) -> None:
        self._trail.happened(
            "guard late",
            f"{name} {self._in_words(self._late[name])}",
            category="monitor",
            resource="",
            monitor=name,
        )

    def _record_heartbeat(self, why: str) -> None:
        event = "heartbeat ended" if why else "heartbeat begun"
        self._trail.happened(event, why or "every guard can act", category="monitor", resource="")
