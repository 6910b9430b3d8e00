"""What is switched off and should act: monitors that are disabled or in shadow mode, audit-only sections of the policy.

Each of them is easily forgotten. It is listed with its age, and when it was off for longer than `forgotten_after` it is
recorded once, as an alarm. A monitor that comes back by itself counts only when its time is over and it is still off.
Ages count the time for which the appliance runs: a clock that is set, or stands wrong after a start, ends no age.
"""

import asyncio
import time
from collections.abc import Iterator
from typing import Literal, NamedTuple

import msgspec

from appliance.channel.answers.status import SwitchedOff
from appliance.control.policies import Policies
from appliance.policy.sections import DECIDERS
from appliance.specifications.specifications import Monitors
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_SETTING = "switched off"
_LOOK_SECONDS = 60.0


class Off(NamedTuple):
    """Something that does not act; `name` is the monitor's or section's, `what` a sentence without its end."""

    about: Literal["monitors", "policy"]
    name: str
    what: str
    again: str
    """What brings it back."""
    until: float | None = None


class _Age(msgspec.Struct):
    """`since` is seconds since the epoch, `seconds` for how long the appliance ran since; `told`: it was recorded."""

    since: float
    seconds: float = 0.0
    told: bool = False


def off_now(monitors: Monitors, policies: Policies) -> Iterator[Off]:
    """Everything that an operator switched off."""
    for name, to in monitors.switches.switched_off().items():
        if to is False:
            again, until = f"rosrv monitor enable {name}", monitors.returns.until(name)
            yield Off("monitors", name, f"monitor {name} is disabled", again, until)
        else:
            yield Off("monitors", name, f"monitor {name} is in shadow mode", f"rosrv monitor promote {name}")
    policy = policies.current
    for decider in DECIDERS:
        if policy.audit_only(decider.categories[0]):
            what = f"section [{decider.name}] of the policy is audit-only"
            yield Off("policy", decider.name, what, "take `audit-only` out of the policy, and load it")


class SwitchedOffWatch:
    """Keeps the ages over restarts."""

    def __init__(
        self,
        monitors: Monitors,
        policies: Policies,
        store: StateStore,
        trail: AuditTrail,
        forgotten_after: float | None,
    ) -> None:
        self._monitors, self._policies = monitors, policies
        self._store, self._trail = store, trail
        self._forgotten_after = forgotten_after
        self._ages = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, _Age])

    def rows(self) -> list[SwitchedOff]:
        """Everything that is off now."""
        self._look(0.0)
        return [
            SwitchedOff(
                off.about,
                off.name,
                off.what,
                off.again,
                self._ages[off.what].since,
                off.until,
                self._ages[off.what].told,
            )
            for off in off_now(self._monitors, self._policies)
        ]

    async def watch(self) -> None:
        """Look each minute."""
        while True:
            before = time.monotonic()
            await asyncio.sleep(_LOOK_SECONDS)
            self.look(time.monotonic() - before)

    def look(self, seconds: float) -> None:
        """So many seconds have passed: record what was forgotten."""
        self._look(seconds)
        if self._ages:
            self._save()
        for off in off_now(self._monitors, self._policies):
            age = self._ages[off.what]
            if age.told or self._forgotten_after is None or age.seconds < self._forgotten_after:
                continue
            age.told = True
            self._save()
            self._trail.happened(
                "protection forgotten",
                f"{off.what} for more than {age.seconds / 3600:.1f} h: {off.again}",
                category="monitor" if off.about == "monitors" else None,
                resource=off.name,
                since=age.since,
            )

    def _look(self, seconds: float) -> None:
        """Begin the ages of what is off since, end those of what is not, and let the others grow."""
        off = {one.what: one for one in off_now(self._monitors, self._policies)}
        if off.keys() != self._ages.keys():
            now = time.time()
            self._ages = {what: self._ages.get(what) or _Age(now) for what in off}
            self._save()
        for what, one in off.items():
            if one.until is None or one.until + _LOOK_SECONDS < time.time():
                self._ages[what].seconds += seconds

    def _save(self) -> None:
        self._store.save_setting(_SETTING, msgspec.json.encode(self._ages).decode())
