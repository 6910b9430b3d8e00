"""Change the registry, and return the effects: updates for nodes, relayed topics, records.

Every change of the graph is a method here, so that no change lacks its effects. The method changes the registry and the
grants, and returns the effects. The caller passes the effects to `enactor`. The effects `RegisterAtMaster` and
`UnregisterAtMaster` describe every change of the registrations of live nodes, in order.

Lists of publishers come from the registry at the time of the change, and values of parameters from the call that set
them. Later calls of the ROS master's notification threads are ignored, because they can be outdated, wrong, or partial
(while the ROS master is rebuilt).
"""

import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.master.graph.effects import (
    CloseNode,
    DropCalls,
    Effects,
    NodeCall,
    RegisterAtMaster,
    TellNode,
    UnregisterAtMaster,
    WriteRecord,
)
from appliance.master.graph.grants import Grants
from appliance.master.graph.mediation import Mediation
from appliance.master.graph.parameter_updates import settled, updates_of
from appliance.master.graph.registry import Incarnation, Kind, Life, NodeRegistration, Registry
from appliance.policy.model import Address, Decision
from appliance.rpc.bulk import weigh
from appliance.specifications.allocation import SERVICE, TOPIC
from appliance.store.state_file import PermissionRow
from roswire.parameter_tree import Tree, standing_at
from roswire.xmlrpc import Value


@dataclass(frozen=True, slots=True)
class RosGraph:
    """Change the graph. `may_read_value(node, key, value)` returns whether a node may read a parameter's value.

    `tree` returns the present parameters.
    """

    registry: Registry
    grants: Grants
    mediation: Mediation
    tree: Callable[[], Tree]
    may_read_value: Callable[[Incarnation, str, Value], bool]

    def registered(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> Effects:
        effects = self._take_name(incarnation)
        if incarnation.life is Life.SHADOW:  # the node was lost while its call was under way
            effects += self.returned(incarnation)
        if kind is Kind.SERVICE:
            for provider in list(self.registry.registered(Kind.SERVICE, resource)):
                if (
                    provider is not incarnation
                ):  # like the ROS master, keep only the last provider of a service
                    effects += self.unregistered(provider, Kind.SERVICE, resource)
        new = (kind, resource) not in incarnation.registrations
        effects += self.registry.register(incarnation, kind, resource, detail)
        effects.append(RegisterAtMaster(incarnation, incarnation.registrations[kind, resource]))
        if kind is Kind.PUBLICATION:
            effects += self.tell(resource)
        if new:
            reason = f"{incarnation.name} registered {resource}"
            effects.append(_record("registered", reason, incarnation, kind.value, resource))
        return effects

    def unregistered(self, incarnation: Incarnation, kind: Kind, resource: str) -> Effects:
        """Remove a registration of a node, if the node has it, or else the withdrawn one."""
        registration = incarnation.registrations.get((kind, resource))
        if registration is None:
            return [*self.registry.unshelve(incarnation, kind, resource)]
        effects = _at_master(incarnation, [registration])
        effects += self.registry.unregister(incarnation, kind, resource)
        if kind is Kind.PUBLICATION:
            effects += self.tell(resource)
        elif kind is Kind.SUBSCRIPTION:
            incarnation.told_lists.pop(resource, None)
            effects += self._give_up(incarnation, resource)
        reason = f"{incarnation.name} unregistered {resource}"
        return [*effects, _record("unregistered", reason, incarnation, kind.value, resource)]

    def revoked(
        self, incarnation: Incarnation, registration: NodeRegistration, decision: Decision, call: str
    ) -> Effects:
        """Withdraw a registration that is no longer allowed, and store it for later. `call`: see `revocation`."""
        kind, resource = registration.kind, registration.resource
        effects: Effects = [
            revocation(decision, str(incarnation.host), incarnation.name, kind.value, resource, call=call),
            *self.unregistered(incarnation, kind, resource),
            *self.registry.shelve(incarnation, registration),
        ]
        if kind is Kind.SUBSCRIPTION and incarnation.life is Life.LIVE:
            effects.append(_emptied(incarnation, resource))
        return effects

    def granted_again(self, incarnation: Incarnation, registration: NodeRegistration) -> Effects:
        """Restore a registration that the policy withdrew. Forget a service that another node now offers."""
        kind, resource = registration.kind, registration.resource
        if kind is Kind.SERVICE and self._others_offer(incarnation, resource):
            return [*self.registry.unshelve(incarnation, kind, resource)]
        effects = self.registered(incarnation, kind, resource, registration.detail)
        if kind is Kind.SUBSCRIPTION:
            effects += self.remind(incarnation, resource)
        elif kind is Kind.PARAMETER:
            effects += self._tell_parameter(incarnation, resource)
        return effects

    def _others_offer(self, incarnation: Incarnation, service: str) -> bool:
        return any(holder is not incarnation for holder in self.registry.registered(Kind.SERVICE, service))

    def _take_name(self, incarnation: Incarnation) -> Effects:
        """Take the name from its holder, and forget the holder's withdrawn registrations."""
        other = self.registry.occupant(incarnation.name)
        if other is None or other is incarnation:
            return []
        effects = self.replaced(other, incarnation) if other.registrations else []
        for kind, resource in list(other.shelf):
            effects += self.registry.unshelve(other, kind, resource)
        return effects

    def replaced(self, incarnation: Incarnation, by: Incarnation) -> Effects:
        """Shut down an incarnation whose name another incarnation took, with the ROS master's text."""
        lost = list(incarnation.registrations.values())
        reason = f"[{incarnation.name}] Reason: new node registered with same name"
        other = by.host != incarnation.host
        return [
            *_at_master(incarnation, lost),
            *self.registry.replace(incarnation, clock.now()),
            TellNode(incarnation, NodeCall("shutdown", (reason,))),
            *self._tell_withdrawn(lost),
            *self._close(incarnation),
            _record(
                "takeover" if other else "replaced",
                f"{by.name} of {by.host} replaced the node of this name of {incarnation.host}",
                by,
                severity=Severity.NOTICE if other else Severity.INFO,
            ),
        ]

    def lost(self, incarnation: Incarnation, why: str) -> Effects:
        """Suspend the registrations of a node that no longer answers, until it returns."""
        return [
            *_at_master(incarnation, incarnation.in_order()),
            *self.registry.overshadow(incarnation, clock.now()),
            *self._tell_withdrawn(incarnation.registrations.values()),
            DropCalls(incarnation),
            _record("node lost", why, incarnation, severity=Severity.NOTICE),
        ]

    def returned(self, incarnation: Incarnation) -> Effects:
        """Restore the registrations of a lost node that answers again.

        If another node has offered a service of the lost node in the meantime, that node keeps the service.
        """
        effects = self._take_name(incarnation)
        for service in incarnation.resources(Kind.SERVICE):
            if self._others_offer(incarnation, service):
                effects += self.unregistered(incarnation, Kind.SERVICE, service)
        effects += self.registry.revive(incarnation, clock.now())
        for registration in incarnation.in_order():
            effects.append(RegisterAtMaster(incarnation, registration))
            if registration.kind is Kind.PUBLICATION:
                effects += self.tell(registration.resource)
            elif registration.kind is Kind.SUBSCRIPTION:
                effects += self._tell_one(incarnation, registration.resource, always=True)
        for kind, topic in incarnation.shelf:
            # The policy withdrew these while the node was away, or earlier without reaching the node.
            if kind is Kind.SUBSCRIPTION:
                effects.append(_emptied(incarnation, topic))
        effects += self.tell_parameters(incarnation)
        return [*effects, _record("node returned", f"{incarnation.name} answers again", incarnation)]

    def forgotten(self, incarnation: Incarnation) -> Effects:
        registrations = list(incarnation.registrations.values())
        effects = _at_master(incarnation, registrations)
        effects += [*self.registry.forget(incarnation), *self._tell_withdrawn(registrations)]
        if self.registry.holder(incarnation.name) is None:
            for registration in registrations:
                if registration.kind is Kind.SUBSCRIPTION:
                    effects += self._give_up(incarnation, registration.resource)
        return [*effects, *self._close(incarnation), DropCalls(incarnation)]

    def _close(self, incarnation: Incarnation) -> Effects:
        return [*self.grants.forget(incarnation.key), CloseNode(incarnation)]

    # --- grants ---

    def topic_granted(self, publisher: Incarnation, topic: str, host: Address, caller_id: str) -> Effects:
        return self.grants.give(PermissionRow(publisher.key, TOPIC, topic, str(host), caller_id))

    def service_granted(self, provider: Incarnation, service: str, host: Address, caller_id: str) -> Effects:
        """Let a client call a service of a provider, unless the client has no name."""
        row = PermissionRow(provider.key, SERVICE, service, str(host), caller_id)
        return self.grants.give(row) if caller_id else []

    def _give_up(self, subscriber: Incarnation, topic: str) -> Effects:
        """Remove the grants of a subscriber that gave up a topic, for all publishers of the topic.

        Grants are for a name and a host, so a later subscriber with the same two keeps them.
        """
        other = self.registry.holder(subscriber.name)
        if (
            other is not None
            and other is not subscriber
            and other.host == subscriber.host
            and (Kind.SUBSCRIPTION, topic) in other.registrations
        ):
            return []
        host, name = str(subscriber.host), subscriber.name
        return [
            effect
            for publisher in self.registry.registered(Kind.PUBLICATION, topic)
            for effect in self.grants.take(PermissionRow(publisher.key, TOPIC, topic, host, name))
        ]

    # --- updates for subscribers ---

    def tell(self, topic: str, *, always: bool = False) -> Effects:
        """Send every subscriber of a topic its list of publishers, if the list has changed or `always` is true."""
        subscribers = self.registry.registered(Kind.SUBSCRIPTION, topic)
        return [
            effect
            for subscriber in subscribers
            for effect in self._tell_one(subscriber, topic, always=always)
        ]

    def tell_everybody(self, concerned: Callable[[str], bool] = lambda _topic: True) -> Effects:
        """Send all subscribers the lists of all `concerned` topics: after a rebuild, for a new relay or control.

        The list of a revoked topic is empty. It is sent again, because control may have died before it was delivered.
        """
        topics = {
            registration.resource
            for _node, registration in self.registry.in_order()
            if registration.kind is Kind.SUBSCRIPTION
        }
        effects = [
            effect for topic in sorted(topics) if concerned(topic) for effect in self.tell(topic, always=True)
        ]
        for node in self.registry.live():
            for kind, topic in node.shelf:
                if kind is Kind.SUBSCRIPTION and concerned(topic):
                    effects.append(_emptied(node, topic))
        return effects

    def renew_all(self, topic: str) -> Effects:
        """Have every subscriber of a topic drop its publishers and connect again, at their new ports."""
        publishers = list(self.registry.registered(Kind.PUBLICATION, topic))
        subscribers = self.registry.registered(Kind.SUBSCRIPTION, topic)
        return [effect for subscriber in subscribers for effect in self.renew(subscriber, topic, publishers)]

    def remind(self, subscriber: Incarnation, topic: str) -> Effects:
        """Send a subscriber its list for a topic again, or an empty list if the policy withdrew the subscription."""
        if (Kind.SUBSCRIPTION, topic) in subscriber.registrations:
            return self._tell_one(subscriber, topic, always=True)
        return [_emptied(subscriber, topic)] if (Kind.SUBSCRIPTION, topic) in subscriber.shelf else []

    def parameter_set(self, key: str, value: Value, caller_id: str) -> Effects:
        """Return the updates for a value that the ROS master accepted; the caller gets none for exactly this key."""
        return self._tell_parameters(key, value, caller_id)

    def parameter_deleted(self, key: str) -> Effects:
        return self._tell_parameters(key, {}, None)

    def _tell_parameters(self, key: str, value: Value, caller_id: str | None) -> Effects:
        effects: Effects = []
        if not self.registry.tells_parameters:
            return effects
        calls: dict[str, NodeCall] = {}
        for update in updates_of(key, value, self.registry.subscribed_below(key)):
            for subscriber in self.registry.registered(Kind.PARAMETER, update.subscribed):
                if update.key == key and subscriber.name == caller_id:
                    continue
                if update.key not in calls:
                    calls[update.key] = _param_update(update.key, settled(update.value))
                if self.may_read_value(subscriber, update.key, update.value):
                    effects.append(TellNode(subscriber, calls[update.key]))
        return effects

    def tell_parameters(self, subscriber: Incarnation) -> Effects:
        keys = subscriber.resources(Kind.PARAMETER)
        return [effect for key in keys for effect in self._tell_parameter(subscriber, key)]

    def _tell_parameter(self, subscriber: Incarnation, key: str) -> Effects:
        """Send a node the present value of a parameter, if the node may read this value.

        The subscription was decided by the keys that existed then, so the right to read is checked again.
        """
        present, _ = standing_at(self.tree(), key)
        value = {} if present is None else settled(present)
        told = self.may_read_value(subscriber, key, value)
        return [TellNode(subscriber, _param_update(key, value))] if told else []

    def renew(self, subscriber: Incarnation, topic: str, absent: Collection[Incarnation]) -> Effects:
        """Have a subscriber drop these publishers and connect again, because roscpp ignores an unchanged list."""
        if not absent:
            return self.remind(subscriber, topic)
        gone = {publisher.outer_uri(subscriber.told) for publisher in absent}
        without = [uri for uri in self._publishers_for(subscriber, topic) if uri not in gone]
        return [_list(subscriber, topic, without), *self.remind(subscriber, topic)]

    def absent(
        self, subscribers: Iterable[Incarnation]
    ) -> Iterator[tuple[Incarnation, str, list[Incarnation]]]:
        """Yield each relayed topic of these subscribers with the publishers that the subscriber is not connected to.

        Grants do not matter: if one was withdrawn unnoticed, the subscriber asks again only after it drops the
        publisher. So the result depends only on data that survive a restart.
        """
        used = self.grants.used()
        for subscriber in subscribers:
            for topic in subscriber.resources(Kind.SUBSCRIPTION):
                publishers = [
                    publisher
                    for publisher in self.registry.registered(Kind.PUBLICATION, topic)
                    if publisher is not subscriber
                    and (publisher.own or subscriber.own or self.mediation.carries_topic(topic))
                    and PermissionRow(publisher.key, TOPIC, topic, str(subscriber.host), subscriber.name)
                    not in used
                ]
                if publishers:
                    yield subscriber, topic, publishers

    def list_for(self, subscriber: Incarnation, topic: str) -> list[str]:
        """Return the list for the answer to a registration, and store the list so that only later changes are sent."""
        uris = self._publishers_for(subscriber, topic)
        subscriber.told_lists[topic] = uris
        return list(uris)

    def _tell_one(self, subscriber: Incarnation, topic: str, *, always: bool) -> Effects:
        uris = self._publishers_for(subscriber, topic)
        if not always and subscriber.told_lists.get(topic) == uris:
            return []
        subscriber.told_lists[topic] = uris
        return [_list(subscriber, topic, uris)]

    def _publishers_for(self, subscriber: Incarnation, topic: str) -> tuple[str, ...]:
        hidden = self.mediation.hides_publishers(topic)
        return self.registry.uris_for(subscriber, Kind.PUBLICATION, topic, hidden=hidden)

    def _tell_withdrawn(self, registrations: Iterable[NodeRegistration]) -> Effects:
        topics = [
            registration.resource for registration in registrations if registration.kind is Kind.PUBLICATION
        ]
        return [effect for topic in topics for effect in self.tell(topic)]


def revocation(
    decision: Decision, host: str, caller_id: str, category: str, resource: str, *, call: str
) -> WriteRecord:
    """Return the audit record of a withdrawal.

    `call` is the call that the policy no longer allows; empty if the policy is not the reason.
    """
    about = {"call": call, "needs": decision.needs}
    return WriteRecord(
        "revoked",
        decision.reason,
        host,
        caller_id,
        category,
        resource,
        severity=Severity.WARNING,
        decision="deny",
        rule=decision.rule,
        more={name: text for name, text in about.items() if text and call},
    )


def _record(
    event: str,
    reason: str,
    node: Incarnation,
    category: str = "node",
    resource: str | None = None,
    *,
    severity: Severity = Severity.INFO,
) -> WriteRecord:
    level = Severity.INFO if node.own else severity  # rosout is lost at each start
    return WriteRecord(event, reason, str(node.host), node.name, category, resource or node.name, level)


def _at_master(incarnation: Incarnation, ended: Iterable[NodeRegistration]) -> Effects:
    """End these registrations at the ROS master, which has only those of live nodes."""
    if incarnation.life is not Life.LIVE:
        return []
    return [UnregisterAtMaster(incarnation, registration) for registration in ended]


def _list(subscriber: Incarnation, topic: str, uris: Iterable[str]) -> TellNode:
    return TellNode(subscriber, NodeCall("publisherUpdate", (topic, list(uris))))


def _emptied(subscriber: Incarnation, topic: str) -> TellNode:
    """Send a subscriber an empty list, because client libraries drop a publisher only if a list does not contain it."""
    return _list(subscriber, topic, ())


def _param_update(key: str, value: Value) -> NodeCall:
    """Return the same call as the ROS master makes: the key ends with `/`, and the value of an unset key is `{}`."""
    return NodeCall("paramUpdate", (f"{key.rstrip('/')}/", value), weigh(value, sys.maxsize))
