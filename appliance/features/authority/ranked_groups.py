"""The groups with a rank, in which the highest node that moves drives: record hand-overs, and say who drives.

The relays decide (`relay/ranked_topic.py`) and report. Each group has a latched topic, `/rosrv/driver/GROUP`.
"""

import asyncio
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from appliance.base import clock
from appliance.channel.messages import OwnHeaderStated, OwnPublished, RankReported
from appliance.channel.messages.relay_link import RankStanding
from appliance.control.core import RelayOrders
from appliance.control.errors import SenselessError, UnavailableError
from appliance.control.motion_stop import StopAfter
from appliance.policy.authority import AuthorityGroup
from appliance.policy.model import Address
from appliance.policy.policy import Policy
from appliance.telemetry.audit_trail import AuditTrail

STRING = ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
"""The type of the topics, its md5sum and its definition."""
_UNKNOWN = RankReported("", "", 0, "unknown")
_HEARD: tuple[RankStanding, ...] = ("moving", "lost")


@dataclass(frozen=True, slots=True)
class RankedDriver:
    """The driver of a group, or the last one. `host` is empty if it is not known. `since` is in monotonic seconds."""

    report: RankReported
    node: str = ""
    host: str = ""
    since: float = 0.0
    freed_by: str = ""
    group: str = ""

    @property
    def standing(self) -> RankStanding:
        return self.report.standing

    @property
    def holder(self) -> str:
        return self.host if self.standing in _HEARD else ""

    def why(self, group: AuthorityGroup) -> str:
        name = f"{self.node or 'a node that ended'} on {self.host or 'an unknown host'}"
        remedy = f"rosrv drive free {group.name}"
        match self.standing:
            case "moving":
                return f"{name} moves it"
            case "lost":
                return (
                    f"{name} fell silent after a motion: lower ranks wait until it lets go, or for {remedy}"
                )
            case "free":
                let_go = f"{self.freed_by} freed it" if self.freed_by else f"{name} let go"
                return (
                    f"the next node that moves drives: {let_go}"
                    if self.report.key or self.freed_by
                    else "free"
                )
            case "unknown":
                first = group.in_words(0)
                return (
                    f"after a start, only {first} may move it: others wait until it lets go, or for {remedy}"
                )


class RankedGroups:
    """The drivers of all groups with a rank. `find(key)` returns the name and the host of a node."""

    def __init__(
        self,
        policy: Callable[[], Policy],
        trail: AuditTrail,
        relay: RelayOrders,
        stop: StopAfter,
        *,
        node: str,
        find: Callable[[str], tuple[str, Address | None]],
    ) -> None:
        self._policy = policy
        self._trail = trail
        self._relay = relay
        self._stop = stop
        self._node = node
        self._find = find
        self._drivers: dict[str, RankedDriver] = {}  # by topic
        self._freed_by = ""
        self._lost: asyncio.Queue[RankReported] = asyncio.Queue()
        relay.ranks.listeners.append(self._on_report)

    def policy_changed(self) -> None:
        """Publish the drivers of the groups that have a rank now, and forget all others."""
        groups = {group.topic: group for group in self._policy().authority.values() if group.ranks}
        self._relay.ranks.keep(groups)
        before, self._drivers = self._drivers, {}
        for topic, driver in before.items():
            group = groups.get(topic)
            if group is not None:
                self._drivers[topic] = replace(driver, group=group.name)
            if group is None or group.name != driver.group:
                self._record(driver, RankedDriver(_UNKNOWN, group=driver.group))
                self._record(RankedDriver(_UNKNOWN), self._drivers.get(topic, RankedDriver(_UNKNOWN)))
        self._relay.publish_only("authority", self._headers(groups.values()) if groups else ())
        for group in groups.values():
            self._publish(group)

    def driver(self, group: AuthorityGroup) -> RankedDriver:
        return self._drivers.get(group.topic, RankedDriver(_UNKNOWN))

    def forgot(self, group: AuthorityGroup) -> bool:
        """Return whether no relay knows who moves the group, as after a start of the appliance."""
        return self.driver(group).standing == "unknown"

    def hears(self, group: AuthorityGroup, host: Address, node: str) -> bool:
        """Return whether a node may move the group, unless one of a higher rank does: after a loss or a start, lower
        ranks wait for a person.
        """
        driver = self.driver(group)
        rank = group.rank(self._policy().atoms_of(host), node)
        last = driver.report.rank if driver.standing == "lost" else 0
        return driver.standing in ("moving", "free") or (rank is not None and rank <= last)

    async def free(self, group: AuthorityGroup, who: str) -> None:
        """Hand a group back, so that all its ranks may move. Raises `SenselessError` or `UnavailableError`."""
        driver = self.driver(group)
        if driver.standing == "moving":
            raise SenselessError(f"{driver.node} moves {group.name}: it hands it back when it lets go")
        if driver.standing == "free":
            return
        self._freed_by = who
        try:
            freed = self._relay.ranks.free(group.topic)
        finally:
            self._freed_by = ""
        if not freed:
            raise UnavailableError(f"a relay is starting, so {group.name} cannot be handed back: try again")
        await self._relay.carried_out({group.topic})

    async def stop_lost(self) -> None:
        """Let the guards stop what a lost driver commanded, one loss after the other."""
        while True:
            lost = await self._lost.get()
            group, driver = self._policy().command_group(lost.topic), self._drivers.get(lost.topic)
            if group is not None and driver is not None and driver.report == lost:
                await self._stop(driver.host, {lost.topic}, f"{group.name}: {driver.why(group)}")

    def _on_report(self, report: RankReported) -> None:
        group = self._policy().command_group(report.topic)
        if group is None or not group.ranks:
            return
        before = self.driver(group)
        node, host = self._find(report.key) if report.key else ("", None)
        if report.key == before.report.key and not node:  # it has ended
            node, found = before.node, before.host
        else:
            found = "" if host is None else str(host)
        now = RankedDriver(report, node, found, clock.now(), self._freed_by, group.name)
        self._drivers[report.topic] = now
        self._record(before, now)
        if report.standing == "lost":
            self._lost.put_nowait(report)
        self._publish(group)

    def _record(self, before: RankedDriver, now: RankedDriver) -> None:
        """Record a change of the holder, or of its node."""
        if before.holder == now.holder and (not before.holder or before.report.key == now.report.key):
            return
        earlier, later = before.holder or "nobody", now.holder or "nobody"
        reason = {
            "moving": "moved",
            "lost": "fell silent after a motion",
            "free": f"freed by {now.freed_by}" if now.freed_by else "let go",
            "unknown": "the policy no longer ranks the group",
        }[now.standing]
        node = now.node or before.node
        self._trail.happened(
            "authority handed over",
            f"{now.group}: from {earlier} to {later}: {reason}{f' ({node})' if node else ''}",
            host=now.holder or before.holder or None,
            resource=now.group,
            whole=True,
            earlier=earlier,
            holder=later,
            who=now.freed_by,
        )

    def _headers(self, groups: Iterable[AuthorityGroup]) -> list[OwnHeaderStated]:
        return [OwnHeaderStated(self._topic(group), *STRING, latching=True) for group in groups]

    def _topic(self, group: AuthorityGroup) -> str:
        return f"{self._node}/driver/{group.name}"

    def _publish(self, group: AuthorityGroup) -> None:
        text = self.driver(group).why(group).encode()
        self._relay.publish(OwnPublished(self._topic(group), struct.pack("<I", len(text)) + text))
