"""Build the part of control for alarms."""

from collections.abc import Iterable

from appliance.channel.alarms import AlarmList, activity, open_alarms
from appliance.control.core import Alarms, ControlPart, Core
from appliance.control.errors import UnknownThingError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.alarms.diagnostics import Diagnostics
from appliance.features.alarms.requests import (
    AlarmAcknowledge,
    AlarmSilence,
    AlarmsWanted,
)
from appliance.telemetry.audit_trail import AuditTrail

# Answer operators' requests about alarms. `control/operators/handled_alarms.py` stores acknowledgements and
# silences.


class AlarmOrders:
    """Answers requests about the alarms in the status."""

    def __init__(self, alarms: Alarms, trail: AuditTrail) -> None:
        self._handled = alarms.handled
        self._trail = trail
        self._status = alarms.status

    async def list_alarms(self, _request: AlarmsWanted) -> AlarmList:
        return self._list()

    async def acknowledge(self, request: AlarmAcknowledge, who: str) -> AlarmList:
        for kind in self._present(request.kind):
            earlier = self._handled.state(kind)
            if self._handled.acknowledge(kind, who, request.note):
                text = f"{kind} is acknowledged"
                self._record("alarm acknowledged", text, kind, who, request.note, earlier=earlier)
        return self._list()

    async def silence(self, request: AlarmSilence, who: str) -> AlarmList:
        if (seconds := request.seconds) is None:
            return self._sound_again(request.kind, who)
        for kind in self._present(request.kind):
            earlier = self._handled.state(kind)
            until = self._handled.silence(kind, who, request.note, seconds)
            text = f"{kind} is silenced for {seconds:.0f} s"
            self._record("alarm silenced", text, kind, who, request.note, earlier=earlier, until=until)
        return self._list()

    def _sound_again(self, wanted: str, who: str) -> AlarmList:
        ended = _meant(wanted, (row.kind for row in self._status().handled_alarms))
        if not ended:
            raise UnknownThingError(
                f"the alarm {wanted[:200]} is neither silenced nor acknowledged: rosrv alarm list"
            )
        for kind in ended:
            earlier = self._handled.state(kind)
            self._handled.end(kind)
            self._record("alarm sounds again", f"{kind} is an alarm again", kind, who, "", earlier=earlier)
        return self._list()

    def _list(self) -> AlarmList:
        status = self._status()
        return AlarmList([*open_alarms(status), *activity(status)], status.name)

    def _present(self, wanted: str) -> list[str]:
        present = [alarm.kind for alarm in self._list().alarms]
        if not (found := _meant(wanted, present)):
            known = f"there are: {', '.join(present)}" if present else "there is none now"
            raise UnknownThingError(f"there is no alarm {wanted[:200]!r}; {known}")
        return found

    def _record(self, event: str, text: str, kind: str, who: str, note: str, **more: object) -> None:
        self._trail.happened(
            event,
            f"{text}: {note}" if note else text,
            resource=kind,
            who=who,
            note=note,
            whole=True,
            more=more,
        )


def _meant(wanted: str, kinds: Iterable[str]) -> list[str]:
    """Return the kinds that a name means: itself, and those that it begins before a colon."""
    return [kind for kind in kinds if kind == wanted or kind.startswith(f"{wanted}:")]


async def begin(core: Core) -> ControlPart:
    orders = AlarmOrders(core.alarms, core.trail)
    work = {}
    if core.settings.alarms_on_diagnostics:
        work["the alarms on /diagnostics"] = Diagnostics(
            core.alarms, core.relay, core.settings.publish_as
        ).run
    return ControlPart(
        (
            RequestMethod(AlarmsWanted, orders.list_alarms, order=False),
            RequestMethod(AlarmAcknowledge, orders.acknowledge, who=True),
            RequestMethod(AlarmSilence, orders.silence, who=True),
        ),
        work,
    )
