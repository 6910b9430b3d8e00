"""Keep the alarms that operators have acknowledged or silenced, across restarts and takeovers.

1. An acknowledgement ends with its alarm, so the same condition is a new alarm when it comes back. After a start, it
   waits up to `_START_SECONDS` for its alarm, because a condition such as `standby-away` is an alarm only after a time.
2. A silence ends at its time, even without its alarm.
"""

import msgspec

from appliance.base import clock
from appliance.channel.alarms import activity, open_alarms
from appliance.channel.answers.status import HandledAlarm, Status
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore

_SETTING = "handled alarms"
_START_SECONDS = 300.0  # the alarms that take longest after a start need about 90 s
SILENCES = EndKind("silence")


class HandledAlarms:
    """The alarms that an operator has acknowledged or silenced, by kind."""

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        self._store = store
        self._ends = ends
        self._rows = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, HandledAlarm])
        self._awaited = {*self._rows}
        """The kinds handled before this start whose alarm was not present since."""
        self._began = clock.now()
        ends.when_due(SILENCES, self._due)

    def with_marks(self, status: Status) -> Status:
        present = {alarm.kind for alarm in (*open_alarms(status), *activity(status))}
        self._awaited -= present
        if clock.now() - self._began >= _START_SECONDS:
            self._awaited.clear()
        present |= self._awaited
        kept = {
            kind: row
            for kind, row in self._rows.items()
            if (kind in present if row.until is None else not self._ends.is_over(SILENCES, kind))
        }
        if len(kept) < len(self._rows):
            self._keep(kept)
        return msgspec.structs.replace(status, handled_alarms=[self._date(row) for row in kept.values()])

    def state(self, kind: str) -> str:
        row = self._rows.get(kind)
        return "not handled" if row is None else "acknowledged" if row.until is None else "silenced"

    def acknowledge(self, kind: str, who: str, note: str) -> bool:
        """Return False if the same person has acknowledged it with the same note."""
        row = self._rows.get(kind)
        if row is not None and (row.who, row.until, row.note) == (who, None, note):
            return False
        self._keep({**self._rows, kind: HandledAlarm(kind, who, clock.wall(), None, note)})
        return True

    def silence(self, kind: str, who: str, note: str, seconds: float) -> float:
        """Silence an alarm; return the end in seconds since the epoch."""
        until = clock.wall() + seconds
        with self._store.database.together():
            self._ends.set(SILENCES, kind, seconds)
            self._keep({**self._rows, kind: HandledAlarm(kind, who, clock.wall(), until, note)})
        return until

    def end(self, kind: str) -> bool:
        if kind not in self._rows:
            return False
        self._keep({other: row for other, row in self._rows.items() if other != kind})
        return True

    def _date(self, row: HandledAlarm) -> HandledAlarm:
        until = None if row.until is None else self._ends.date(SILENCES, row.kind)
        return msgspec.structs.replace(row, until=until)

    def _due(self, ended: list[str]) -> None:
        self._keep({kind: row for kind, row in self._rows.items() if kind not in ended or row.until is None})
        self._ends.forget(SILENCES, *ended)

    def _keep(self, rows: dict[str, HandledAlarm]) -> None:
        self._rows = rows
        silenced = {kind for kind, row in rows.items() if row.until is not None}
        self._ends.forget(SILENCES, *(name for name in self._ends.names(SILENCES) if name not in silenced))
        self._store.save_setting(_SETTING, msgspec.json.encode(rows).decode())
