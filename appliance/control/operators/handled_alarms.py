"""Keep the alarms that operators have acknowledged or silenced, across restarts and takeovers.

1. An acknowledgement ends with its alarm, so the same condition is a new alarm when it comes back.
2. A silence ends at its time, even without its alarm. A clock that is set back does not extend it while control runs,
   and ends it if its start is then in the future.
"""

import msgspec

from appliance.base import clock
from appliance.base.deadlines import Deadlines
from appliance.channel.alarms import activity, open_alarms
from appliance.channel.answers.status import HandledAlarm, Status
from appliance.store.state_file import StateStore

_SETTING = "handled alarms"


def silences_moved(store: StateStore, seconds: float) -> None:
    """Move the silences to a clock that is ahead by `seconds`."""
    kept = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, HandledAlarm])
    moved = {
        kind: row
        if row.until is None
        else msgspec.structs.replace(row, since=row.since + seconds, until=row.until + seconds)
        for kind, row in kept.items()
    }
    store.save_setting(_SETTING, msgspec.json.encode(moved).decode())


class HandledAlarms:
    """The alarms that an operator has acknowledged or silenced, by kind."""

    def __init__(self, store: StateStore) -> None:
        self._store = store
        self._rows = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, HandledAlarm])
        self._ends = Deadlines()

    def marked(self, status: Status) -> Status:
        present = {alarm.kind for alarm in (*open_alarms(status), *activity(status))}
        kept = {
            kind: row
            for kind, row in self._rows.items()
            if (kind in present if row.until is None else not self._is_over(row))
        }
        if len(kept) < len(self._rows):
            self._keep(kept)
        return msgspec.structs.replace(status, handled_alarms=list(kept.values()))

    def put(self, row: HandledAlarm) -> None:
        self._is_over(row)  # starts its time since boot
        self._keep({**self._rows, row.kind: row})

    def end(self, kind: str) -> bool:
        if kind not in self._rows:
            return False
        self._keep({other: row for other, row in self._rows.items() if other != kind})
        return True

    def _is_over(self, row: HandledAlarm) -> bool:
        return row.until is not None and (clock.wall() < row.since or self._ends.passed(row.kind, row.until))

    def _keep(self, rows: dict[str, HandledAlarm]) -> None:
        self._rows = rows
        self._ends.retain(rows)
        self._store.save_setting(_SETTING, msgspec.json.encode(rows).decode())
