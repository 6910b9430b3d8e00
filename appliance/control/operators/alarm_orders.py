"""Keep which alarms operators have acknowledged or silenced.

An alarm is a present condition (`channel/alarms.py`). An acknowledged alarm names the operator who takes care of it. A
silenced alarm is a notice for a time. Both are stored, so they survive a restart and a takeover.

Invariants:
1. An acknowledgement ends with its alarm, so the same condition is a new alarm when it comes back.
2. A silence ends at its time, also without its alarm. It ends early if the clock was set back before its beginning, so
   a wrong clock never extends it.
"""

from collections.abc import Callable

import msgspec

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.alarms import AlarmList, activity, open_alarms
from appliance.channel.answers.status import HandledAlarm, Status
from appliance.channel.rest_bodies import LONGEST_SILENCE_SECONDS
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_SETTING = "handled alarms"


class HandledAlarms:
    """The alarms that an operator has acknowledged or silenced, by kind."""

    def __init__(self, store: StateStore) -> None:
        self._store = store
        self._rows = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, HandledAlarm])

    def marked(self, status: Status) -> Status:
        """Return the status with the acknowledged and silenced alarms; forget those that are over."""
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
        """Store an acknowledgement or a silence, in place of an earlier one of the alarm."""
        self._keep({**self._rows, row.kind: row})

    def end(self, kind: str) -> bool:
        """Forget what was stored for an alarm; return whether there was anything."""
        if kind not in self._rows:
            return False
        self._keep({other: row for other, row in self._rows.items() if other != kind})
        return True

    def _keep(self, rows: dict[str, HandledAlarm]) -> None:
        self._rows = rows
        self._store.save_setting(_SETTING, msgspec.json.encode(rows).decode())


class AlarmOrders:
    """The answers and orders about alarms. `status()` returns the present status, with the handled alarms."""

    def __init__(self, handled: HandledAlarms, trail: AuditTrail, status: Callable[[], Status]) -> None:
        self._handled = handled
        self._trail = trail
        self._status = status

    async def listed(self, _request: admin.AlarmsWanted) -> AlarmList:
        """Return the present alarms, the most severe first."""
        return self._list()

    async def acknowledge(self, request: admin.AlarmAcknowledge, who: str) -> AlarmList:
        """Record who takes care of an alarm. Raises `UnknownThingError` if there is no such alarm."""
        self._must_be_present(request.kind)
        self._handled.put(HandledAlarm(request.kind, who, clock.wall(), None, request.note))
        self._record("alarm acknowledged", f"{request.kind} is acknowledged", request.kind, who, request.note)
        return self._list()

    async def silence(self, request: admin.AlarmSilence, who: str) -> AlarmList:
        """Make an alarm a notice for a time, or end that. Raises `UnknownThingError` and `SenselessError`."""
        kind, seconds = request.kind, request.seconds
        if seconds is None:
            if not self._handled.end(kind):
                raise UnknownThingError(f"the alarm {kind[:200]} is neither silenced nor acknowledged")
            self._record("alarm sounds again", f"{kind} is an alarm again", kind, who, "")
            return self._list()
        if not 1 <= seconds <= LONGEST_SILENCE_SECONDS:
            raise SenselessError(f"silence an alarm for 1 to {LONGEST_SILENCE_SECONDS:.0f} seconds")
        self._must_be_present(kind)
        now = clock.wall()
        self._handled.put(HandledAlarm(kind, who, now, now + seconds, request.note))
        self._record(
            "alarm silenced",
            f"{kind} is silenced for {seconds:.0f} s",
            kind,
            who,
            request.note,
            until=now + seconds,
        )
        return self._list()

    def _list(self) -> AlarmList:
        status = self._status()
        return AlarmList([*open_alarms(status), *activity(status)], status.name)

    def _must_be_present(self, kind: str) -> None:
        present = [alarm.kind for alarm in self._list().alarms]
        if kind not in present:
            known = f"there are: {', '.join(present)}" if present else "there is none now"
            raise UnknownThingError(f"there is no alarm {kind[:200]!r}; {known}")

    def _record(self, event: str, text: str, kind: str, who: str, note: str, **more: float) -> None:
        self._trail.happened(
            event,
            f"{text}: {note}" if note else text,
            resource=kind,
            who=who,
            note=note,
            whole=True,
            more=more,
        )
