"""Decide all registrations and grants again after a change of the policy, for live nodes and for lost nodes.

A registration that is no longer allowed is kept for a later policy, because a ROS 1 node never registers twice.

rosout, a C++ program that parses the log messages of all nodes, is the appliance's own node, and is not trusted. It may
only make the registrations of an unmodified rosout, and read the parameters that roscpp reads at its start.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Life, NodeRegistration, Registry
from appliance.policy.live_rights import LiveRight, live_by, may_keep
from appliance.policy.model import Address, Decision, address_of
from appliance.policy.policy import Policy
from appliance.specifications.allocation import TOPIC
from appliance.store.state_file import PermissionRow
from roswire.parameter_tree import Tree

OWN = "the appliance's own node"
_RESOURCES = {
    Kind.PUBLICATION: frozenset({"/rosout_agg"}),
    Kind.SUBSCRIPTION: frozenset({"/rosout"}),
    Kind.SERVICE: frozenset({"/rosout/get_loggers", "/rosout/set_logger_level"}),
}
OWN_PARAMETERS = frozenset(
    {
        "/enable_statistics",
        "/statistics_window_max_elements",
        "/statistics_window_max_size",
        "/statistics_window_min_elements",
        "/statistics_window_min_size",
        "/tcp_keepalive",
        "/use_sim_time",
    }
)


def rosout_may_have(kind: Kind, resource: str) -> bool:
    return resource in _RESOURCES.get(kind, ())


CALLS = {
    Kind.PUBLICATION: ("registerPublisher", "unregisterPublisher"),
    Kind.SUBSCRIPTION: ("registerSubscriber", "unregisterSubscriber"),
    Kind.SERVICE: ("registerService", "unregisterService"),
    Kind.PARAMETER: ("subscribeParam", "unsubscribeParam"),
}
"""The calls of the Master API that register and unregister each kind of resource."""


@dataclass(frozen=True, slots=True)
class Revocation:
    """Decides rights again, by the present policy and the present parameters."""

    registry: Registry
    grants: Grants
    graph: RosGraph
    policy: Callable[[], Policy]
    tree: Callable[[], Tree]

    def live(self) -> list[LiveRight]:
        return [
            *(
                self._registered(incarnation, registration.kind, registration.resource)
                for incarnation, registration in self._registrations()
                if not incarnation.own
            ),
            *(self._granted(row) for row in self.grants.all() if not self._is_own(row)),
        ]

    def redecide(self) -> int:
        """Revoke denied rights, and restore allowed ones; return the number of revoked rights."""
        count = self._redecide(self._registrations(), self.grants.all())
        for incarnation in self.registry.live():
            self.returned(incarnation)
        return count

    def redecide_for(self, host: Address, caller_id: str) -> int:
        """Revoke rights of a caller whose call was decided before a policy change and carried out after it."""
        return self._redecide(
            [pair for pair in self._registrations() if (pair[0].host, pair[0].name) == (host, caller_id)],
            [row for row in self.grants.of_client(caller_id) if row.host == str(host)],
        )

    def _redecide(
        self, registrations: list[tuple[Incarnation, NodeRegistration]], grants: list[PermissionRow]
    ) -> int:
        count = 0
        for incarnation, registration in registrations:
            decision = self._decide(incarnation, registration.kind, registration.resource)
            if not decision.allowed:
                call = "" if incarnation.own else CALLS[registration.kind][0]
                self.graph.revoked(incarnation, registration, decision, call)
                count += 1
        for row in grants:
            decision = self._decide_grant(row)
            if not decision.allowed:
                self._revoke(row, decision, self._granted(row).call)
                count += 1
        return count

    def expel(self, host: Address, reason: str) -> int:
        """Revoke all rights of a host, whatever the policy says. Return their number."""
        count, decision = 0, Decision(False, None, reason)
        for incarnation, registration in self._registrations():
            if incarnation.host == host and not incarnation.own:
                self.graph.revoked(incarnation, registration, decision, "")
                count += 1
        for row in self.grants.all():
            if row.host == str(host):
                self._revoke(row, decision, "")
                count += 1
        return count

    def returned(self, incarnation: Incarnation) -> None:
        holder = self.registry.holder(incarnation.name)
        if holder is not None and holder is not incarnation:
            return
        for registration in sorted(incarnation.shelf.values(), key=lambda registration: registration.order):
            if self.may_have(incarnation, registration.kind, registration.resource):
                self.graph.granted_again(incarnation, registration)

    def _registrations(self) -> list[tuple[Incarnation, NodeRegistration]]:
        pairs = [
            (incarnation, registration)
            for incarnation in self.registry.all()
            if incarnation.life is not Life.REPLACED
            for registration in incarnation.registrations.values()
        ]
        return sorted(pairs, key=lambda pair: pair[1].order)

    def _revoke(self, row: PermissionRow, decision: Decision, call: str) -> None:
        self.grants.take(row)
        self.graph.record_revocation(decision, row.host, row.caller_id, row.kind, row.resource, call=call)

    def may_have(self, incarnation: Incarnation, kind: Kind, resource: str) -> bool:
        return self._decide(incarnation, kind, resource).allowed

    def _decide(self, incarnation: Incarnation, kind: Kind, resource: str) -> Decision:
        if incarnation.own:
            known = incarnation.of_monitors or rosout_may_have(kind, resource)
            return Decision(known, None, OWN if known else f"{OWN} no longer has this")
        return may_keep(self.policy(), self._registered(incarnation, kind, resource))

    def _decide_grant(self, row: PermissionRow) -> Decision:
        if self._is_own(row):
            return Decision(True, None, OWN)
        return may_keep(self.policy(), self._granted(row))

    def _is_own(self, row: PermissionRow) -> bool:
        holder = self.registry.holder(row.caller_id)
        return row.kind == TOPIC and holder is not None and holder.own

    def _registered(self, incarnation: Incarnation, kind: Kind, resource: str) -> LiveRight:
        return live_by(CALLS[kind][0], incarnation.host, incarnation.name, resource, self.tree())

    def _granted(self, row: PermissionRow) -> LiveRight:
        call = "requestTopic" if row.kind == TOPIC else "lookupService"
        return LiveRight(address_of(row.host), row.caller_id, call, row.resource)
