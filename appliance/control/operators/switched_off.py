"""List switched-off protection: monitors that are disabled or in shadow mode, and audit-only sections of the policy.

A monitor that is due to come back ages only if it is still off after that time. Ages count the running time of the
appliance, so they do not depend on the system clock.
"""

import asyncio
from collections.abc import Iterator

import msgspec

from appliance.base import clock
from appliance.channel.answers.status import SwitchedOff
from appliance.control.assembly.policies import Policies
from appliance.policy.sections import DECIDERS
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_SETTING = "switched off"
_LOOK_SECONDS = 60.0


class _Age(msgspec.Struct):
    """An age: its start (seconds since the epoch), the running time since then, and whether an alarm was recorded."""

    since: float
    seconds: float = 0.0
    told: bool = False


def off_now(monitors: SpecificationManager, policies: Policies) -> Iterator[SwitchedOff]:
    now = clock.wall()
    for name, to in monitors.switches.switched_off().items():
        if to is False:
            again, until = f"rosrv monitor enable {name}", monitors.returns.until(name)
            yield SwitchedOff("monitors", name, f"monitor {name} is disabled", again, now, until, False)
        else:
            what, again = f"monitor {name} is in shadow mode", f"rosrv monitor enforce {name}"
            yield SwitchedOff("monitors", name, what, again, now, None, False)
    policy = policies.current
    for decider in DECIDERS:
        if policy.audit_only(decider.categories[0]):
            what = f"section [{decider.name}] of the policy is audit-only"
            again = "remove `audit-only` from the policy, and load it"
            yield SwitchedOff("policy", decider.name, what, again, now, None, False)


class SwitchedOffWatch:
    """The ages of switched-off protection, which survive restarts."""

    def __init__(
        self,
        monitors: SpecificationManager,
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
        self._look(0.0)
        return [
            msgspec.structs.replace(off, since=age.since, forgotten=age.told)
            for off in off_now(self._monitors, self._policies)
            for age in [self._ages[off.what]]
        ]

    async def watch(self) -> None:
        while True:
            before = clock.now()
            await asyncio.sleep(_LOOK_SECONDS)
            self.look(clock.now() - before)

    def look(self, seconds: float) -> None:
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
        off = {one.what: one for one in off_now(self._monitors, self._policies)}
        if off.keys() != self._ages.keys():
            self._ages = {what: self._ages.get(what) or _Age(one.since) for what, one in off.items()}
            self._save()
        for what, one in off.items():
            if one.until is None or one.until + _LOOK_SECONDS < clock.wall():
                self._ages[what].seconds += seconds

    def _save(self) -> None:
        self._store.save_setting(_SETTING, msgspec.json.encode(self._ages).decode())
