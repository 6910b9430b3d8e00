"""Keep the alarms that operators have acknowledged or silenced, across restarts and takeovers.

1. An acknowledgement ends with its alarm, so the same condition is a new alarm when it comes back.
2. A silence ends at its time, even without its alarm. It ends early if the clock is set back to before its start, so
   a wrong clock never extends it.
"""

import msgspec

from appliance.base import clock
from appliance.channel.alarms import activity, open_alarms
from appliance.channel.answers.status import HandledAlarm, Status
from appliance.store.state_file import StateStore

_SETTING = "handled alarms"


class HandledAlarms:
    """The alarms that an operator has acknowledged or silenced, by kind."""

    def __init__(self, store: StateStore) -> None:
        self._store = store
        self._rows = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, HandledAlarm])

    def marked(self, status: Status) -> Status:
        present = {alarm.kind for alarm in (*open_alarms(status), *activity(status))}
        now = clock.wall()
        kept = {
            kind: row
            for kind, row in self._rows.items()
            if (kind in present if row.until is None else row.since <= now < row.until)
        }
        if len(kept) < len(self._rows):
            self._keep(kept)
        return msgspec.structs.replace(status, handled_alarms=list(kept.values()))

    def put(self, row: HandledAlarm) -> None:
        self._keep({**self._rows, row.kind: row})

    def end(self, kind: str) -> bool:
        if kind not in self._rows:
            return False
        self._keep({other: row for other, row in self._rows.items() if other != kind})
        return True

    def _keep(self, rows: dict[str, HandledAlarm]) -> None:
        self._rows = rows
        self._store.save_setting(_SETTING, msgspec.json.encode(rows).decode())
