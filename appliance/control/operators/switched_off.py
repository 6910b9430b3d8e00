"""List switched-off protection: monitors that are disabled or in shadow mode, and audit-only sections of the policy.

A monitor that is due to come back ages only if it is still off after that time. Ages count the running time of the
appliance, so they do not depend on the system clock.
"""

import asyncio
from collections.abc import Callable, Iterator, Mapping

import msgspec

from appliance.base import clock
from appliance.channel.answers.status import SwitchedOff
from appliance.policy.policy import Policy
from appliance.policy.sections import DECIDERS
from appliance.specifications.switches import Switch
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_SETTING = "switched off"
_LOOK_SECONDS = 60.0


class _Age(msgspec.Struct):
    """An age: its start (seconds since the epoch), the running time since then, and whether an alarm was recorded."""

    since: float
    seconds: float = 0.0
    told: bool = False


class SwitchedOffWatch:
    """The ages of switched-off protection, which survive restarts.

    `switched_off` returns the monitors that are disabled or in shadow mode, and `until` when one comes back.
    """

    def __init__(
        self,
        switched_off: Callable[[], Mapping[str, Switch]],
        until: Callable[[str], float | None],
        policy: Callable[[], Policy],
        *,
        store: StateStore,
        trail: AuditTrail,
        forgotten_after: float | None,
    ) -> None:
        self._switched_off, self._until, self._policy = switched_off, until, policy
        self._store, self._trail = store, trail
        self._forgotten_after = forgotten_after
        self._ages = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, _Age])

    def rows(self) -> list[SwitchedOff]:
        self._look(0.0)
        return [
            msgspec.structs.replace(off, since=age.since, forgotten=age.told)
            for off in self._off_now()
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
        for off in self._off_now():
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
        off = {one.what: one for one in self._off_now()}
        if off.keys() != self._ages.keys():
            self._ages = {what: self._ages.get(what) or _Age(one.since) for what, one in off.items()}
            self._save()
        for what, one in off.items():
            if one.until is None or one.until + _LOOK_SECONDS < clock.wall():
                self._ages[what].seconds += seconds

    def _off_now(self) -> Iterator[SwitchedOff]:
        now = clock.wall()
        for name, to in self._switched_off().items():
            if to is False:
                again, until = f"rosrv monitor enable {name}", self._until(name)
                yield SwitchedOff("monitors", name, f"monitor {name} is disabled", again, now, until, False)
            else:
                what, again = f"monitor {name} is in shadow mode", f"rosrv monitor enforce {name}"
                yield SwitchedOff("monitors", name, what, again, now, None, False)
        policy = self._policy()
        for decider in DECIDERS:
            if policy.audit_only(decider.categories[0]):
                what = f"section [{decider.name}] of the policy is audit-only"
                again = "remove `audit-only` from the policy, and load it"
                yield SwitchedOff("policy", decider.name, what, again, now, None, False)

    def _save(self) -> None:
        self._store.save_setting(_SETTING, msgspec.json.encode(self._ages).decode())
