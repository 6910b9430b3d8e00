"""After a change of the policy, what nodes have is decided again: those that live, and those that are away for now.

What is no longer allowed is taken back, and remembered: what is allowed again (a rollback, a change that was not
confirmed in time) is put back, because a ROS 1 node never registers twice.
"""

import asyncio
import ipaddress
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import structlog

from appliance.audit.record import Severity
from appliance.master.graph.graph import Graph
from appliance.master.graph.registrar import CALLS, Registrar
from appliance.master.graph.registry import Incarnation, Kind, Life, Registration, Registry
from appliance.master.reach.own_node import OWN, ROSOUT
from appliance.master.reach.relays import RelayControl
from appliance.policy import Policy
from appliance.policy.live import Live, live_by, may_keep
from appliance.policy.model import Address, Decision
from appliance.recorder import Recorder
from appliance.ros.parameter_tree import Tree
from appliance.rpc.client import CallFailedError
from appliance.specifications.allocation import TOPIC
from appliance.store.state import PermissionRow

_log = structlog.get_logger()


class Revocation:
    """Decides again what the registry and the relay's grants hold, by `policy()` and the parameters that are now.

    `put_back(incarnation, registrations)` tells ROSMaster of those that the node still has when it is their turn.
    """

    def __init__(
        self,
        registry: Registry,
        graph: Graph,
        relay: RelayControl,
        registrar: Registrar,
        recorder: Recorder,
        *,
        policy: Callable[[], Policy],
        parameters: Callable[[], Tree],
        put_back: Callable[[Incarnation, list[Registration]], Awaitable[None]],
    ) -> None:
        self._registry = registry
        self._graph = graph
        self._relay = relay
        self._registrar = registrar
        self._recorder = recorder
        self._policy = policy
        self._parameters = parameters
        self._put_back = put_back
        self._last: asyncio.Task[None] | None = None

    def live(self) -> list[Live]:
        """What `redecide` decides: all that nodes have by the policy."""
        return [
            *(
                self._registered(incarnation, registration.kind, registration.resource)
                for incarnation, registration in self._registrations()
                if not incarnation.own
            ),
            *(self._permitted(row) for row in self._relay.permissions() if not self._is_own(row)),
        ]

    def redecide(self) -> int:
        """Take back what the running policy no longer allows; how much that was. What it grants again is put back."""
        count = self._redecide(self._registrations(), self._relay.permissions())
        self._grant_again()
        return count

    def redecide_for(self, host: Address, caller_id: str) -> int:
        """The same for what one caller has: his call was decided before the policy changed, and carried out after."""
        return self._redecide(
            [pair for pair in self._registrations() if (pair[0].host, pair[0].name) == (host, caller_id)],
            [row for row in self._relay.permissions() if (row.host, row.caller_id) == (str(host), caller_id)],
        )

    def _redecide(
        self, registrations: list[tuple[Incarnation, Registration]], grants: list[PermissionRow]
    ) -> int:
        count = 0
        for incarnation, registration in registrations:
            decision = self._decide(incarnation, registration.kind, registration.resource)
            if not decision.allowed:
                self._take_back(incarnation, registration, decision)
                count += 1
        for row in grants:
            decision = self._decide_permission(row)
            if not decision.allowed:
                self._relay.revoke(row)
                self._record(row, decision)
                count += 1
        return count

    def expel(self, host: Address, reason: str) -> int:
        """Take back all that a host has, whatever the policy says; how much that was."""
        decision, count = Decision(False, None, reason), 0
        for incarnation, registration in self._registrations():
            if incarnation.host == host and not incarnation.own:
                self._take_back(incarnation, registration, decision)
                count += 1
        for row in self._relay.permissions():
            if row.host == str(host):
                self._relay.revoke(row)
                self._record(row, decision)
                count += 1
        return count

    def returned(self, incarnation: Incarnation) -> None:
        """A node that was away is back: it gets what was taken from it and has been granted again meanwhile."""
        if self._registry.holder(incarnation.name) in (None, incarnation):
            self._give_back(incarnation)

    def _registrations(self) -> list[tuple[Incarnation, Registration]]:
        """Every registration that counts now or will when its node is back, in the order they were made."""
        pairs = [
            (one, each)
            for one in self._registry.all()
            if one.life is not Life.REPLACED
            for each in one.registrations.values()
        ]
        return sorted(pairs, key=lambda pair: pair[1].order)

    def _take_back(self, incarnation: Incarnation, registration: Registration, decision: Decision) -> None:
        self._graph.revoked(incarnation, registration, decision)
        if incarnation.life is Life.LIVE:  # else ROSMaster has been told
            self._tell(incarnation, registration)

    def _grant_again(self) -> None:
        """Put back what an earlier policy took from running nodes and this one grants: they never register twice."""
        for incarnation in self._registry.live():
            self.returned(incarnation)

    def _give_back(self, incarnation: Incarnation) -> None:
        """The registry has it at once, so that the next change of the policy finds it; ROSMaster hears in its turn."""
        allowed = [
            one for one in incarnation.shelf.values() if self.may_have(incarnation, one.kind, one.resource)
        ]
        back = [
            one
            for one in sorted(allowed, key=lambda one: one.order)
            if self._graph.granted_again(incarnation, one)
        ]
        if back:
            self._in_background(self._told(self._put_back(incarnation, back), incarnation))

    def may_have(self, incarnation: Incarnation, kind: Kind, resource: str) -> bool:
        """Whether the policy in force grants a node what it has, had, or seems to have."""
        return self._decide(incarnation, kind, resource).allowed

    def _decide(self, incarnation: Incarnation, kind: Kind, resource: str) -> Decision:
        if incarnation.own:
            known = incarnation.of_monitors or ROSOUT.may_have(kind, resource)
            return Decision(known, None, OWN if known else f"{OWN} does not have this any more")
        return may_keep(self._policy(), self._registered(incarnation, kind, resource))

    def _decide_permission(self, row: PermissionRow) -> Decision:
        if self._is_own(row):
            return Decision(True, None, OWN)
        return may_keep(self._policy(), self._permitted(row))

    def _is_own(self, row: PermissionRow) -> bool:
        holder = self._registry.holder(row.caller_id)
        return row.kind == TOPIC and holder is not None and holder.own

    def _registered(self, incarnation: Incarnation, kind: Kind, resource: str) -> Live:
        return live_by(CALLS[kind][0], incarnation.host, incarnation.name, resource, self._parameters())

    def _permitted(self, row: PermissionRow) -> Live:
        call = "requestTopic" if row.kind == TOPIC else "lookupService"
        return Live(ipaddress.ip_address(row.host), row.caller_id, call, row.resource)

    def _tell(self, incarnation: Incarnation, registration: Registration) -> None:
        self._in_background(self._told(self._withdraw(incarnation, registration), incarnation))

    async def _withdraw(self, incarnation: Incarnation, registration: Registration) -> None:
        kind, resource = registration.kind, registration.resource
        if (kind, resource) not in incarnation.registrations:  # else it has been granted again
            await self._registrar.withdraw(incarnation, kind, resource)

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        """After what is under way: ROSMaster hears of changes in the order they were made."""
        before = self._last

        async def in_turn() -> None:
            if before is not None:
                await asyncio.wait([before])
            await work

        self._last = asyncio.get_running_loop().create_task(in_turn())

    async def _told(self, telling: Awaitable[None], incarnation: Incarnation) -> None:
        try:
            await telling
        except CallFailedError as error:
            _log.warning("ROSMaster was not told", node=incarnation.name, error=str(error))  # reconcile will

    def _record(self, row: PermissionRow, decision: Decision) -> None:
        self._recorder.happened(
            "revoked",
            decision.reason,
            severity=Severity.WARNING,
            decision="deny",
            host=row.host,
            caller_id=row.caller_id,
            category=row.kind,
            resource=row.resource,
            rule=decision.rule,
        )
