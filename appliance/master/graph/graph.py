"""A change of the registry and what follows from it: who is told, what the relay carries, what is recorded.

Every way in which the graph changes is a verb here, so that no change can happen without its consequences: it changes
the registry and the grants, and returns the effects, which whoever calls has `enactor` carry out. The
lists of publishers that subscribers get are made from the registry at the moment of the change, values of parameters
from the call that set them, never from what ROSMaster's notification threads say later: what is partial (while
ROSMaster is rebuilt), out of date or misread by ROSMaster never reaches a node.
"""

import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass

from appliance.audit.record import Severity
from appliance.master.graph.effects import (
    CloseNode,
    DropCalls,
    Effects,
    NodeCall,
    Place,
    PlaceGrant,
    PlaceNode,
    Record,
    TellNode,
    Withdraw,
    WithdrawNode,
)
from appliance.master.graph.grants import Grants
from appliance.master.graph.mediation import Mediation
from appliance.master.graph.parameter_updates import settled, updates_of
from appliance.master.graph.registry import Incarnation, Kind, Life, Registration, Registry
from appliance.policy.model import Address, Decision, address_of
from appliance.policy.policy import Policy
from appliance.policy.rate_limits import Part
from appliance.rpc.bulk import weigh
from appliance.specifications.allocation import SERVICE, TOPIC
from appliance.store.state_file import PermissionRow
from roswire.xmlrpc import Value

_CARRIED = (Kind.PUBLICATION, Kind.SERVICE)


@dataclass(frozen=True, slots=True)
class Graph:
    """The verbs. `may_be_told(node, key, value)` says whether the policy lets a node read a parameter's value."""

    registry: Registry
    grants: Grants
    mediation: Mediation
    may_be_told: Callable[[Incarnation, str, Value], bool]

    def registered(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> Effects:
        """ROSMaster took a registration."""
        effects = self._take_name(incarnation)
        if incarnation.life is Life.SHADOW:  # it was lost while its call was under way
            effects += self.returned(incarnation)
        if kind is Kind.SERVICE:
            for provider in list(self.registry.registered(Kind.SERVICE, resource)):
                if provider is not incarnation:  # ROSMaster keeps one provider of a service: the last
                    effects += self.unregistered(provider, Kind.SERVICE, resource)
        new = (kind, resource) not in incarnation.registrations
        effects += self.registry.register(incarnation, kind, resource, detail)
        if kind in _CARRIED:
            effects.append(Place(incarnation, kind, resource, detail))
        if kind is Kind.PUBLICATION:
            effects += self.tell(resource)
        if new:
            reason = f"{incarnation.name} registered {resource}"
            effects.append(_record("registered", reason, incarnation, kind.value, resource))
        return effects

    def unregistered(self, incarnation: Incarnation, kind: Kind, resource: str) -> Effects:
        """A registration is gone at ROSMaster."""
        effects: Effects = [*self.registry.unregister(incarnation, kind, resource)]
        if not effects:
            return [*self.registry.unshelve(incarnation, kind, resource)]
        if kind in _CARRIED:
            effects.append(Withdraw(incarnation, kind, resource))
        if kind is Kind.PUBLICATION:
            effects += self.tell(resource)
        elif kind is Kind.SUBSCRIPTION:
            incarnation.told_lists.pop(resource, None)
            effects += self._give_up(incarnation, resource)
        reason = f"{incarnation.name} unregistered {resource}"
        return [*effects, _record("unregistered", reason, incarnation, kind.value, resource)]

    def revoked(
        self, incarnation: Incarnation, registration: Registration, decision: Decision, call: str
    ) -> Effects:
        """A registration is no longer allowed (`call`: see `revocation`); it is gone at ROSMaster."""
        kind, resource = registration.kind, registration.resource
        effects: Effects = [
            revocation(decision, str(incarnation.host), incarnation.name, kind.value, resource, call=call),
            *self.unregistered(incarnation, kind, resource),
            *self.registry.shelve(incarnation, registration),
        ]
        if kind is Kind.SUBSCRIPTION and incarnation.life is Life.LIVE:
            effects.append(_emptied(incarnation, resource))
        return effects

    def granted_again(self, incarnation: Incarnation, registration: Registration) -> Effects:
        """What the policy took back counts again, and ROSMaster is to hear of it; unless another has it now."""
        kind, resource = registration.kind, registration.resource
        if kind is Kind.SERVICE and self._others_offer(incarnation, resource):
            return [*self.registry.unshelve(incarnation, kind, resource)]
        effects = self.registered(incarnation, kind, resource, registration.detail)
        return effects + self.remind(incarnation, resource) if kind is Kind.SUBSCRIPTION else effects

    def _others_offer(self, incarnation: Incarnation, service: str) -> bool:
        return any(holder is not incarnation for holder in self.registry.registered(Kind.SERVICE, service))

    def _take_name(self, incarnation: Incarnation) -> Effects:
        """From whoever has it: also from one that has nothing left, and is not to get anything back any more."""
        other = self.registry.occupant(incarnation.name)
        if other is None or other is incarnation:
            return []
        effects = self.replaced(other, incarnation) if other.registrations else []
        for kind, resource in list(other.shelf):
            effects += self.registry.unshelve(other, kind, resource)
        return effects

    def replaced(self, incarnation: Incarnation, by: Incarnation) -> Effects:
        """Another incarnation took the name; the old one is told to shut down, with ROSMaster's words."""
        lost = list(incarnation.registrations.values())
        reason = f"[{incarnation.name}] Reason: new node registered with same name"
        other = by.host != incarnation.host
        return [
            *self.registry.replace(incarnation, time.monotonic()),
            TellNode(incarnation, NodeCall("shutdown", (reason,))),
            *self._tell_withdrawn(lost),
            *self._close(incarnation),
            _record(
                "takeover" if other else "replaced",
                f"{by.name} of {by.host} took the place of the one of {incarnation.host}",
                by,
                severity=Severity.NOTICE if other else Severity.INFO,
            ),
        ]

    def lost(self, incarnation: Incarnation, why: str) -> Effects:
        """The node does not answer any more: what it had counts for nobody until it returns."""
        return [
            *self.registry.overshadow(incarnation, time.monotonic()),
            *self._tell_withdrawn(incarnation.registrations.values()),
            WithdrawNode(incarnation),
            DropCalls(incarnation),
            _record("node lost", why, incarnation, severity=Severity.NOTICE),
        ]

    def returned(self, incarnation: Incarnation) -> Effects:
        """A lost node answers again, and has what it had; ROSMaster is to be told.

        A service that another offers by now stays his: a service has one provider, the last.
        """
        effects = self._take_name(incarnation)
        for service in incarnation.resources(Kind.SERVICE):
            if self._others_offer(incarnation, service):
                effects += self.unregistered(incarnation, Kind.SERVICE, service)
        effects += self.registry.revive(incarnation, time.monotonic())
        effects.append(PlaceNode(incarnation))
        for registration in incarnation.in_order():
            if registration.kind is Kind.PUBLICATION:
                effects += self.tell(registration.resource)
            elif registration.kind is Kind.SUBSCRIPTION:
                effects += self._tell_one(incarnation, registration.resource, always=True)
        for kind, topic in incarnation.shelf:
            # Taken while it was away, or before and it may not have heard of it.
            if kind is Kind.SUBSCRIPTION:
                effects.append(_emptied(incarnation, topic))
        return [*effects, _record("node returned", f"{incarnation.name} answers again", incarnation)]

    def forgotten(self, incarnation: Incarnation) -> Effects:
        """An incarnation is dropped for good."""
        registrations = list(incarnation.registrations.values())
        effects: Effects = [*self.registry.forget(incarnation), *self._tell_withdrawn(registrations)]
        if self.registry.holder(incarnation.name) is None:
            for registration in registrations:
                if registration.kind is Kind.SUBSCRIPTION:
                    effects += self._give_up(incarnation, registration.resource)
        return [*effects, *self._close(incarnation), DropCalls(incarnation)]

    def _close(self, incarnation: Incarnation) -> Effects:
        """Nobody gets anything of it any more."""
        return [WithdrawNode(incarnation), *self.grants.forget(incarnation.key), CloseNode(incarnation)]

    # --- grants ---

    def topic_granted(self, publisher: Incarnation, topic: str, host: Address, caller_id: str) -> Effects:
        """This subscriber may have this topic of that publisher."""
        return self.grants.give(PermissionRow(publisher.key, TOPIC, topic, str(host), caller_id))

    def service_granted(self, provider: Incarnation, service: str, host: Address, caller_id: str) -> Effects:
        """This client may call this service of that provider. Nobody calls without a name."""
        row = PermissionRow(provider.key, SERVICE, service, str(host), caller_id)
        return self.grants.give(row) if caller_id else []

    def _give_up(self, subscriber: Incarnation, topic: str) -> Effects:
        """The subscriber gave the topic up: its grants for it, on every publisher, are gone.

        Unless another of its name and host has the topic by now: grants are for these two, so they are its own.
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

    def limits_changed(self, before: Policy, now: Policy) -> Effects:
        """Return what states limits again that differ under another policy, and which hosts the policy names."""
        effects: Effects = []
        for node in self.registry.live():
            for registration in node.registrations.values():
                parts = ((Part.PUBLISHER, node.host), (Part.TOPIC, None))
                if registration.kind is Kind.PUBLICATION and (
                    before.names(node.host) != now.names(node.host)
                    or _differ(before, now, registration.resource, parts)
                    or (
                        now.limit(Part.TOPIC, registration.resource)
                        and before.counted_as(node.host) != now.counted_as(node.host)
                    )
                ):
                    effects.append(Place(node, registration.kind, registration.resource, registration.detail))
            for row in self.grants.of(node.key):
                host = address_of(row.host)
                if before.names(host) != now.names(host) or (
                    row.kind == TOPIC and _differ(before, now, row.resource, ((Part.SUBSCRIBER, host),))
                ):
                    effects.append(PlaceGrant(row))
        return effects

    # --- what subscribers are told ---

    def tell(self, topic: str, *, always: bool = False) -> Effects:
        """Give every subscriber of a topic its list, if it has another one (or `always`)."""
        subscribers = self.registry.registered(Kind.SUBSCRIPTION, topic)
        return [
            effect
            for subscriber in subscribers
            for effect in self._tell_one(subscriber, topic, always=always)
        ]

    def tell_everybody(self, concerned: Callable[[str], bool] = lambda _topic: True) -> Effects:
        """Give every subscriber the lists of all (the concerned) topics: after a rebuild, a new relay or control.

        An empty one of a topic that the policy took: control may have died before the subscriber was told.
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
        """Have every subscriber of a topic drop its publishers and take them again: they are reached elsewhere."""
        publishers = list(self.registry.registered(Kind.PUBLICATION, topic))
        subscribers = self.registry.registered(Kind.SUBSCRIPTION, topic)
        return [effect for subscriber in subscribers for effect in self.renew(subscriber, topic, publishers)]

    def remind(self, subscriber: Incarnation, topic: str) -> Effects:
        """Give a subscriber its list of a topic once more; an empty one when the policy took the topic from it."""
        if (Kind.SUBSCRIPTION, topic) in subscriber.registrations:
            return self._tell_one(subscriber, topic, always=True)
        return [_emptied(subscriber, topic)] if (Kind.SUBSCRIPTION, topic) in subscriber.shelf else []

    def parameter_set(self, key: str, value: Value, caller_id: str) -> Effects:
        """ROSMaster took this value; who set it is not told of it where others are who subscribed above."""
        return self._tell_parameters(key, value, caller_id)

    def parameter_deleted(self, key: str) -> Effects:
        """The parameter is gone at ROSMaster."""
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
                if self.may_be_told(subscriber, update.key, update.value):
                    effects.append(TellNode(subscriber, calls[update.key]))
        return effects

    def tell_parameter(self, subscriber: Incarnation, key: str, value: Value) -> Effects:
        """Tell a node the value that a parameter has, which nobody changes any more.

        It is told what it may read: all that comes to be below a key is told to those who subscribed to it, which was
        decided by what was there then.
        """
        told = self.may_be_told(subscriber, key, value)
        return [TellNode(subscriber, _param_update(key, value))] if told else []

    def renew(self, subscriber: Incarnation, topic: str, absent: Collection[Incarnation]) -> Effects:
        """Have a subscriber drop these publishers and take them again: roscpp takes a list it knows for no news."""
        if not absent:
            return self.remind(subscriber, topic)
        gone = {publisher.outer_uri(subscriber.told) for publisher in absent}
        without = [uri for uri in self._publishers_for(subscriber, topic) if uri not in gone]
        return [_list(subscriber, topic, without), *self.remind(subscriber, topic)]

    def absent(
        self, subscribers: Iterable[Incarnation]
    ) -> Iterator[tuple[Incarnation, str, list[Incarnation]]]:
        """Which of their topics these have through the relay, and of which publishers they are not connected to.

        Whether they have a grant does not count: one that was taken while the subscriber heard nothing is asked for
        again only when it drops the publisher. So this follows from what is kept over a restart.
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
        """The list that answers a registration: what the subscriber is told from here on is relative to it."""
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

    def _tell_withdrawn(self, registrations: Iterable[Registration]) -> Effects:
        topics = [
            registration.resource for registration in registrations if registration.kind is Kind.PUBLICATION
        ]
        return [effect for topic in topics for effect in self.tell(topic)]


def revocation(
    decision: Decision, host: str, caller_id: str, category: str, resource: str, *, call: str
) -> Record:
    """The record of something that is taken back.

    `call` gave it and is not allowed by the policy any more; empty where it was not the policy that decided.
    """
    about = {"call": call, "needs": decision.needs}
    return Record(
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
) -> Record:
    about = node.name if resource is None else resource
    return Record(event, reason, str(node.host), node.name, category, about, severity)


def _list(subscriber: Incarnation, topic: str, uris: Iterable[str]) -> TellNode:
    return TellNode(subscriber, NodeCall("publisherUpdate", (topic, list(uris))))


def _emptied(subscriber: Incarnation, topic: str) -> TellNode:
    """Neither client library drops a publisher for anything but a list without it."""
    return _list(subscriber, topic, ())


def _differ(before: Policy, now: Policy, topic: str, parts: Iterable[tuple[Part, Address | None]]) -> bool:
    return any(before.limit(part, topic, host) != now.limit(part, topic, host) for part, host in parts)


def _param_update(key: str, value: Value) -> NodeCall:
    """The call as ROSMaster makes it: keys end with `/`, and an unset one has `{}`."""
    return NodeCall("paramUpdate", (f"{key.rstrip('/')}/", value), weigh(value, sys.maxsize))
