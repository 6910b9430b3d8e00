"""A change of the registry and what follows from it: who is told, what the relay carries, what is recorded.

Every way in which the graph changes is a verb here, so that no change can happen without its consequences. The
lists of publishers that subscribers get are made from the registry at the moment of the change, values of parameters
from the call that set them, never from what ROSMaster's notification threads say later: what is partial (while
ROSMaster is rebuilt), out of date or misread by ROSMaster never reaches a node.
"""

import sys
import time
from collections.abc import Callable, Iterable

from appliance.audit.record import Severity
from appliance.master.graph.delivery import Delivery, NodeCall
from appliance.master.graph.parameter_updates import settled, updates_of
from appliance.master.graph.registry import Incarnation, Kind, Life, Registration, Registry
from appliance.master.reach.mediation import Mediation
from appliance.master.reach.relays import RelayControl
from appliance.policy.model import Decision
from appliance.recorder import Recorder
from appliance.ros.xmlrpc import Value
from appliance.rpc.bulk import weigh


class Graph:
    """The verbs. `closed(incarnation)` is told when an incarnation's faces are to be closed."""

    def __init__(
        self,
        registry: Registry,
        relay: RelayControl,
        delivery: Delivery,
        recorder: Recorder,
        mediation: Mediation,
        *,
        closed: Callable[[Incarnation], None],
        may_be_told: Callable[[Incarnation, str, Value], bool],
    ) -> None:
        self._may_be_told = may_be_told
        self._registry = registry
        self._relay = relay
        self._delivery = delivery
        self._recorder = recorder
        self._mediation = mediation
        self._closed = closed

    def registered(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> None:
        """ROSMaster took a registration."""
        self._take_name(incarnation)
        if incarnation.life is Life.SHADOW:  # it was lost while its call was under way
            self.returned(incarnation)
        if kind is Kind.SERVICE:
            for provider in list(self._registry.registered(Kind.SERVICE, resource)):
                if provider is not incarnation:  # ROSMaster keeps one provider of a service: the last
                    self.unregistered(provider, Kind.SERVICE, resource)
        new = (kind, resource) not in incarnation.registrations
        self._registry.register(incarnation, kind, resource, detail)
        self._relay.placed(incarnation, kind, resource, detail)
        if kind is Kind.PUBLICATION:
            self.tell(resource)
        if new:
            self._record(
                "registered", incarnation, kind, resource, f"{incarnation.name} registered {resource}"
            )

    def unregistered(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        """A registration is gone at ROSMaster."""
        if not self._registry.unregister(incarnation, kind, resource):
            self._registry.unshelve(incarnation, kind, resource)
            return
        self._relay.withdrawn(incarnation, kind, resource)
        if kind is Kind.PUBLICATION:
            self.tell(resource)
        elif kind is Kind.SUBSCRIPTION:
            incarnation.told_lists.pop(resource, None)
            self._relay.revoke_subscriber(incarnation.host, incarnation.name, resource)
        self._record(
            "unregistered", incarnation, kind, resource, f"{incarnation.name} unregistered {resource}"
        )

    def revoked(self, incarnation: Incarnation, registration: Registration, decision: Decision) -> None:
        """The policy no longer allows a registration; it is gone at ROSMaster."""
        self._recorder.happened(
            "revoked",
            decision.reason,
            severity=Severity.WARNING,
            decision="deny",
            host=str(incarnation.host),
            caller_id=incarnation.name,
            category=registration.kind.value,
            resource=registration.resource,
            rule=decision.rule,
        )
        self.unregistered(incarnation, registration.kind, registration.resource)
        self._registry.shelve(incarnation, registration)
        if registration.kind is Kind.SUBSCRIPTION and incarnation.life is Life.LIVE:
            self._empty(incarnation, registration.resource)

    def granted_again(self, incarnation: Incarnation, registration: Registration) -> bool:
        """What the policy took back counts again, and ROSMaster is to hear of it; False when another has it now."""
        if registration.kind is Kind.SERVICE and self._others_offer(incarnation, registration.resource):
            self._registry.unshelve(incarnation, registration.kind, registration.resource)
            return False
        self.registered(incarnation, registration.kind, registration.resource, registration.detail)
        if registration.kind is Kind.SUBSCRIPTION:
            self.remind(incarnation, registration.resource)
        return True

    def _others_offer(self, incarnation: Incarnation, service: str) -> bool:
        return any(one is not incarnation for one in self._registry.registered(Kind.SERVICE, service))

    def _take_name(self, incarnation: Incarnation) -> None:
        """From whoever has it: also from one that has nothing left, and is not to get anything back any more."""
        other = self._registry.occupant(incarnation.name)
        if other is None or other is incarnation:
            return
        if other.registrations:
            self.replaced(other, incarnation)
        for kind, resource in list(other.shelf):
            self._registry.unshelve(other, kind, resource)

    def replaced(self, incarnation: Incarnation, by: Incarnation) -> None:
        """Another incarnation took the name; the old one is told to shut down, with ROSMaster's words."""
        lost = self._registry.replace(incarnation, time.time())
        reason = f"[{incarnation.name}] Reason: new node registered with same name"
        self._delivery.push(incarnation, NodeCall("shutdown", (reason,)))
        self._tell_withdrawn(lost)
        self._relay.forgotten(incarnation)
        self._closed(incarnation)
        other = by.host != incarnation.host
        self._recorder.happened(
            "takeover" if other else "replaced",
            f"{by.name} of {by.host} took the place of the one of {incarnation.host}",
            severity=Severity.NOTICE if other else Severity.INFO,
            host=str(by.host),
            caller_id=by.name,
            category="node",
            resource=by.name,
        )

    def lost(self, incarnation: Incarnation, why: str) -> None:
        """The node does not answer any more: what it had counts for nobody until it returns."""
        lost = self._registry.overshadow(incarnation, time.time())
        self._tell_withdrawn(lost)
        self._relay.node_withdrawn(incarnation)
        self._delivery.drop(incarnation)
        self._recorder.happened(
            "node lost",
            why,
            severity=Severity.NOTICE,
            host=str(incarnation.host),
            caller_id=incarnation.name,
            category="node",
            resource=incarnation.name,
        )

    def returned(self, incarnation: Incarnation) -> list[Registration]:
        """A lost node answers again; what it had, in order, to be put back at ROSMaster.

        A service that another offers by now stays his: a service has one provider, the last.
        """
        self._take_name(incarnation)
        for service in incarnation.resources(Kind.SERVICE):
            if self._others_offer(incarnation, service):
                self.unregistered(incarnation, Kind.SERVICE, service)
        registrations = self._registry.revive(incarnation, time.time())
        self._relay.node_returned(incarnation)
        for registration in registrations:
            if registration.kind is Kind.PUBLICATION:
                self.tell(registration.resource)
            elif registration.kind is Kind.SUBSCRIPTION:
                self._tell_one(incarnation, registration.resource, always=True)
        for kind, topic in incarnation.shelf:
            # Taken while it was away, or before and it may not have heard of it.
            if kind is Kind.SUBSCRIPTION:
                self._empty(incarnation, topic)
        self._recorder.happened(
            "node returned",
            f"{incarnation.name} answers again",
            host=str(incarnation.host),
            caller_id=incarnation.name,
            category="node",
            resource=incarnation.name,
        )
        return registrations

    def forgotten(self, incarnation: Incarnation) -> None:
        """An incarnation is dropped for good."""
        registrations = list(incarnation.registrations.values())
        self._registry.forget(incarnation)
        self._tell_withdrawn(registrations)
        if self._registry.holder(incarnation.name) is None:
            for topic in (one.resource for one in registrations if one.kind is Kind.SUBSCRIPTION):
                self._relay.revoke_subscriber(incarnation.host, incarnation.name, topic)
        self._relay.forgotten(incarnation)
        self._delivery.drop(incarnation)
        self._closed(incarnation)

    # --- what subscribers are told ---

    def tell(self, topic: str, *, always: bool = False) -> None:
        """Give every subscriber of a topic its list, if it has another one (or `always`)."""
        for subscriber in list(self._registry.registered(Kind.SUBSCRIPTION, topic)):
            self._tell_one(subscriber, topic, always=always)

    def tell_everybody(self, concerned: Callable[[str], bool] = lambda _topic: True) -> None:
        """Give every subscriber the lists of all (the concerned) topics, once: after a rebuild or a new relay."""
        topics = {one.resource for _node, one in self._registry.in_order() if one.kind is Kind.SUBSCRIPTION}
        for topic in sorted(topics):
            if concerned(topic):
                self.tell(topic, always=True)

    def renew_all(self, topic: str) -> None:
        """Have every subscriber of a topic drop its publishers and take them again: they are reached elsewhere."""
        publishers = list(self._registry.registered(Kind.PUBLICATION, topic))
        for subscriber in list(self._registry.registered(Kind.SUBSCRIPTION, topic)):
            self.renew(subscriber, topic, publishers)

    def remind(self, subscriber: Incarnation, topic: str) -> None:
        """Give a subscriber its list of a topic once more; an empty one when the policy took the topic from it."""
        if (Kind.SUBSCRIPTION, topic) in subscriber.registrations:
            self._tell_one(subscriber, topic, always=True)
        elif (Kind.SUBSCRIPTION, topic) in subscriber.shelf:
            self._empty(subscriber, topic)

    def parameter_set(self, key: str, value: Value, caller_id: str) -> None:
        """ROSMaster took this value; who set it is not told of it where others are who subscribed above."""
        self._tell_parameters(key, value, caller_id)

    def parameter_deleted(self, key: str) -> None:
        """The parameter is gone at ROSMaster."""
        self._tell_parameters(key, {}, None)

    def _tell_parameters(self, key: str, value: Value, caller_id: str | None) -> None:
        calls: dict[str, NodeCall] = {}
        for update in updates_of(key, value, self._registry.subscribed_below(key)):
            for subscriber in self._registry.registered(Kind.PARAMETER, update.subscribed):
                if update.key == key and subscriber.name == caller_id:
                    continue
                if update.key not in calls:
                    calls[update.key] = _param_update(update.key, settled(update.value))
                if self._may_be_told(subscriber, update.key, update.value):
                    self._delivery.push(subscriber, calls[update.key])

    def tell_parameter(self, subscriber: Incarnation, key: str, value: Value) -> None:
        """Tell a node the value that a parameter has, which nobody changes any more.

        It is told what it may read: all that comes to be below a key is told to those who subscribed to it, which was
        decided by what was there then.
        """
        if self._may_be_told(subscriber, key, value):
            self._delivery.push(subscriber, _param_update(key, value))

    def renew(self, subscriber: Incarnation, topic: str, absent: list[Incarnation]) -> None:
        """Have a subscriber drop these publishers and take them again: roscpp takes a list it knows for no news."""
        gone = {one.outer_uri(subscriber.told) for one in absent}
        without = [uri for uri in self._publishers_for(subscriber, topic) if uri not in gone]
        self._delivery.push(subscriber, NodeCall("publisherUpdate", (topic, list(without))))
        self.remind(subscriber, topic)

    def list_for(self, subscriber: Incarnation, topic: str) -> list[str]:
        """The list that answers a registration: what the subscriber is told from here on is relative to it."""
        uris = self._publishers_for(subscriber, topic)
        subscriber.told_lists[topic] = uris
        return list(uris)

    def _empty(self, subscriber: Incarnation, topic: str) -> None:
        """Neither client library drops a publisher for anything but a list without it."""
        self._delivery.push(subscriber, NodeCall("publisherUpdate", (topic, [])))

    def _tell_one(self, subscriber: Incarnation, topic: str, *, always: bool) -> None:
        uris = self._publishers_for(subscriber, topic)
        if always or subscriber.told_lists.get(topic) != uris:
            subscriber.told_lists[topic] = uris
            self._delivery.push(subscriber, NodeCall("publisherUpdate", (topic, list(uris))))

    def _publishers_for(self, subscriber: Incarnation, topic: str) -> tuple[str, ...]:
        hidden = self._mediation.hides_publishers(topic)
        return self._registry.uris_for(subscriber, Kind.PUBLICATION, topic, hidden=hidden)

    def _tell_withdrawn(self, registrations: Iterable[Registration]) -> None:
        for registration in registrations:
            if registration.kind is Kind.PUBLICATION:
                self.tell(registration.resource)

    def _record(self, event: str, incarnation: Incarnation, kind: Kind, resource: str, reason: str) -> None:
        self._recorder.happened(
            event,
            reason,
            host=str(incarnation.host),
            caller_id=incarnation.name,
            category=kind.value,
            resource=resource,
        )


def _param_update(key: str, value: Value) -> NodeCall:
    """The call as ROSMaster makes it: keys end with `/`, and an unset one has `{}`."""
    return NodeCall("paramUpdate", (f"{key.rstrip('/')}/", value), weigh(value, sys.maxsize))
