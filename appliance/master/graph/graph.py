"""Change the registry and the grants as the calls of nodes, the policy and failures require. No I/O.

Only audit records are written here, because a record is of one change, not of a state; `Sinks` does the rest.

Grants are the topics and services that each client may use. They are stored, because a ROS node never asks twice.
Above its limit, a host loses its oldest grants without a connection; above the common limit, the host with the most
grants does.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.master.graph.registry import Incarnation, Kind, Life, NodeRegistration, Registry
from appliance.policy.model import Address, Decision
from appliance.quotas.pool import Bounds
from appliance.quotas.table import GRANTS
from appliance.specifications.allocation import SERVICE, TOPIC
from appliance.store.state_file import PermissionRow
from appliance.telemetry.audit_trail import AuditTrail

_CLEARED_AT_ONCE = 1000
_Index = dict[str, dict[PermissionRow, None]]  # the oldest grant first


class Grants:
    """All grants. `mark` notes a change; `used()` returns the grants that have a connection now."""

    def __init__(
        self,
        mark: Callable[[PermissionRow], None],
        used: Callable[[], Collection[PermissionRow]],
        bounds: Bounds = GRANTS.bounds,
    ) -> None:
        self._mark = mark
        self.used = used
        self._bounds = bounds
        self._of_node: _Index = {}  # by key of the publisher or provider
        self._of_host: _Index = {}  # by client host
        self._of_name: _Index = {}  # by name of the client
        self._count = 0

    def restore(self, rows: Iterable[PermissionRow]) -> None:
        """Restore stored grants."""
        for row in rows:
            self._add(row)

    def all(self) -> list[PermissionRow]:
        return [row for rows in self._of_node.values() for row in rows]

    def of(self, key: str) -> Collection[PermissionRow]:
        return self._of_node.get(key, ())

    def of_client(self, name: str) -> list[PermissionRow]:
        return list(self._of_name.get(name, ()))

    def give(self, row: PermissionRow) -> None:
        """Give a grant, which becomes the newest of its host even if it existed before."""
        new = row not in self.of(row.key)
        self._add(row)
        if not new:
            return
        self._mark(row)
        if len(self._of_host[row.host]) > self._bounds.host:
            self._clear_unused(row.host, row)
        elif self._count > self._bounds.whole:
            self._clear_unused(max(self._of_host, key=lambda host: len(self._of_host[host])), row)

    def take(self, row: PermissionRow) -> None:
        if row not in self.of(row.key):
            return
        for index, key in self._places(row):
            del index[key][row]
            if not index[key]:
                del index[key]
        self._count -= 1
        self._mark(row)

    def forget(self, key: str) -> None:
        for row in list(self.of(key)):
            self.take(row)

    def _add(self, row: PermissionRow) -> None:
        self._count += row not in self.of(row.key)
        for index, key in self._places(row):
            rows = index.setdefault(key, {})
            rows[row] = rows.pop(row, None)

    def _places(self, row: PermissionRow) -> tuple[tuple[_Index, str], ...]:
        return (self._of_node, row.key), (self._of_host, row.host), (self._of_name, row.caller_id)

    def _clear_unused(self, host: str, newest: PermissionRow) -> None:
        used = self.used()
        unused = [row for row in self._of_host[host] if row != newest and row not in used]
        for row in unused[:_CLEARED_AT_ONCE]:
            self.take(row)


@dataclass(frozen=True, slots=True)
class RosGraph:
    registry: Registry
    grants: Grants
    trail: AuditTrail

    def registered(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> None:
        self._take_name(incarnation)
        if incarnation.life is Life.SHADOW:  # the node was lost while its call was under way
            self.returned(incarnation)
        if kind is Kind.SERVICE:  # like the ROS master, keep only the last provider of a service
            for provider in list(self.registry.registrants(Kind.SERVICE, resource)):
                if provider is not incarnation:
                    self.unregistered(provider, Kind.SERVICE, resource)
        new = (kind, resource) not in incarnation.registrations
        self.registry.register(incarnation, kind, resource, detail)
        if new:
            reason = f"{incarnation.name} registered {resource}"
            if incarnation.reached is False:
                reason += f"; {incarnation.api_text[:80]} cannot be called, so it hears of no later change"
            self._record("registered", reason, incarnation, kind.value, resource)

    def unregistered(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        if (kind, resource) not in incarnation.registrations:
            self.registry.unshelve(incarnation, kind, resource)
            return
        self.registry.unregister(incarnation, kind, resource)
        if kind is Kind.SUBSCRIPTION:
            self._give_up(incarnation, resource)
        reason = f"{incarnation.name} unregistered {resource}"
        self._record("unregistered", reason, incarnation, kind.value, resource)

    def revoked(
        self, incarnation: Incarnation, registration: NodeRegistration, decision: Decision, call: str
    ) -> None:
        kind, resource = registration.kind, registration.resource
        self.record_revocation(
            decision, str(incarnation.host), incarnation.name, kind.value, resource, call=call
        )
        self.unregistered(incarnation, kind, resource)
        self.registry.shelve(incarnation, registration)

    def granted_again(self, incarnation: Incarnation, registration: NodeRegistration) -> None:
        kind, resource = registration.kind, registration.resource
        if kind is Kind.SERVICE and self._others_offer(incarnation, resource):
            self.registry.unshelve(incarnation, kind, resource)
        else:
            self.registered(incarnation, kind, resource, registration.detail)

    def _others_offer(self, incarnation: Incarnation, service: str) -> bool:
        return any(holder is not incarnation for holder in self.registry.registrants(Kind.SERVICE, service))

    def _take_name(self, incarnation: Incarnation) -> None:
        """Take the name from its holder, and from all clients of other hosts.

        Other hosts can no longer make calls under this name, so their grants end.
        """
        other = self.registry.occupant(incarnation.name)
        if other is incarnation:
            return
        if other is not None:
            if other.registrations:
                self.replaced(other, incarnation)
            for kind, resource in list(other.shelf):
                self.registry.unshelve(other, kind, resource)
        for row in self.grants.of_client(incarnation.name):
            if row.host != str(incarnation.host):
                self.grants.take(row)

    def replaced(self, incarnation: Incarnation, by: Incarnation) -> None:
        other = by.host != incarnation.host
        subscribed = incarnation.resources(Kind.SUBSCRIPTION)
        self.registry.replace(incarnation, clock.now())
        self._end_grants(incarnation, subscribed)
        self._record(
            "takeover" if other else "replaced",
            f"{by.name} of {by.host} replaced the node of this name of {incarnation.host}",
            by,
            severity=Severity.NOTICE if other else Severity.INFO,
        )

    def lost(self, incarnation: Incarnation, why: str) -> None:
        self.registry.overshadow(incarnation, clock.now())
        self._record("node lost", why, incarnation, severity=Severity.NOTICE)

    def returned(self, incarnation: Incarnation) -> None:
        """Restore registrations, except services that another node now offers."""
        self._take_name(incarnation)
        for service in incarnation.resources(Kind.SERVICE):
            if self._others_offer(incarnation, service):
                self.unregistered(incarnation, Kind.SERVICE, service)
        self.registry.revive(incarnation, clock.now())
        self._record("node returned", f"{incarnation.name} answers, or is connected, again", incarnation)

    def forgotten(self, incarnation: Incarnation) -> None:
        self.registry.forget(incarnation)
        self._end_grants(incarnation, incarnation.resources(Kind.SUBSCRIPTION))

    # --- grants ---

    def topic_granted(self, publisher: Incarnation, topic: str, host: Address, caller_id: str) -> None:
        self._grant(PermissionRow(publisher.key, TOPIC, topic, str(host), caller_id))

    def service_granted(self, provider: Incarnation, service: str, host: Address, caller_id: str) -> None:
        if caller_id:
            self._grant(PermissionRow(provider.key, SERVICE, service, str(host), caller_id))

    def _grant(self, row: PermissionRow) -> None:
        """Give a grant, unless a node of another host took the client's name after the decision."""
        holder = self.registry.holder(row.caller_id)
        if holder is None or holder.own or str(holder.host) == row.host:
            self.grants.give(row)

    def _end_grants(self, node: Incarnation, subscribed: Iterable[str]) -> None:
        self.grants.forget(node.key)
        for topic in subscribed:
            self._give_up(node, topic)

    def _give_up(self, subscriber: Incarnation, topic: str) -> None:
        """Remove the subscriber's grants for all publishers of a topic, even lost ones.

        Grants are for a name and a host, so another subscriber with the same name and host keeps them.
        """
        other = self.registry.holder(subscriber.name)
        subscribed = other is not None and (Kind.SUBSCRIPTION, topic) in other.registrations
        if other is not None and subscribed and other.host == subscriber.host:
            return
        about = TOPIC, topic, str(subscriber.host)
        for row in self.grants.of_client(subscriber.name):
            if (row.kind, row.resource, row.host) == about:
                self.grants.take(row)

    # --- records ---

    def record_revocation(
        self, decision: Decision, host: str, caller_id: str, category: str, resource: str, *, call: str
    ) -> None:
        about = {"call": call, "needs": decision.needs}
        self.trail.happened(
            "revoked",
            decision.reason,
            severity=Severity.WARNING,
            host=host,
            caller_id=caller_id,
            category=category,
            resource=resource,
            rule=decision.rule,
            decision="deny",
            more={name: text for name, text in about.items() if text and call},
        )

    def _record(
        self,
        event: str,
        reason: str,
        node: Incarnation,
        category: str = "node",
        resource: str | None = None,
        *,
        severity: Severity = Severity.INFO,
    ) -> None:
        self.trail.happened(
            event,
            reason,
            severity=Severity.INFO if node.own else severity,  # rosout is lost at each start
            host=str(node.host),
            caller_id=node.name,
            category=category,
            resource=resource or node.name,
        )
