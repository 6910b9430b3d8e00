"""Say what a new state directory lacks. The configuration may be older, as after another card or `apt purge`."""

from collections.abc import Callable, Mapping

import structlog

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.answers.status import NewState
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

NEW_SECONDS = 86_400.0
"""A state directory counts as new for a day."""

LACKS: Mapping[str, str] = {
    "switches": "monitors are on or off as their files say, or else as the setting `enable` says",
    "values": "constants and topics that operators gave to monitors are those of the files",
    "loaded specifications": "those that are only loaded, not in the folder, are not in force",
    "policy revisions": "the policy's file is in force, without earlier revisions",
    "blocks": "no host is blocked",
    "tokens": "only the first token is valid, and it is new",
    "doors": "only those of the configuration are open, and no ticket is valid",
    "enrolled hosts": "the certificate authority of hosts is new: enrol them again",
    "adoption": "the robot's graph is not adopted: rosrv adopt",
    "registrations": "nodes that ran before must be restarted, and parameters set again",
    "handled alarms": "no alarm is acknowledged or silenced",
    "audit log": "a new log begins, with a new key",
    "memberships": "fleet and standby must be joined again",
}
"""The parts of a state directory, and the consequence if they are missing; the table in docs/reference/processes.md."""

_SETTING = "state began"
_log = structlog.get_logger()


class StateAge:
    """The start of a state directory. It is new if no policy was in force in it; `begin` is called before the first."""

    def __init__(self, store: StateStore, trail: AuditTrail) -> None:
        self._store, self._trail = store, trail
        self._since = float(store.settings().get(_SETTING, "0"))

    def begin(self) -> Callable[[SpecificationManager], None]:
        """Return what to call when the specifications are in force."""
        if self._store.revisions(1):
            return lambda _monitors: None
        self._since = clock.wall()
        self._store.save_setting(_SETTING, repr(self._since))
        return self._record

    def _record(self, monitors: SpecificationManager) -> None:
        on = [name for name in monitors.names() if monitors.switches.is_enabled(name)]
        off = [name for name in monitors.names() if name not in on]
        without = f", without {', '.join(off)}" if off else ""
        text = (
            f"the state directory is new: {counted(len(on), 'monitor')} in force by files and settings{without}; not"
            f" here: {', '.join(LACKS)} of an earlier one"
        )
        _log.warning(text)
        self._trail.happened("state directory new", text, parts=dict(LACKS), on=on, off=off)

    def state(self) -> NewState | None:
        is_new = 0 <= clock.wall() - self._since < NEW_SECONDS
        return NewState(self._since, [*LACKS]) if is_new else None
