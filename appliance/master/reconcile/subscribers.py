"""Keep the nodes informed of the lists of publishers and of the values of parameters that they subscribed to.

Values are sent with each call that sets them, because a node may count the changes. The notifications of the ROS
master are ignored, because they can be outdated, wrong, or partial. The updates are those of rosmaster's
`compute_param_updates`, but depend on the canonical key that the policy allowed the caller to change, never on names in
a value:

1. Subscribers to the changed key, or to a key above it, get the changed key and its value.
2. Subscribers to a key below it get their part of the new value, or `{}`, unless the value is not a namespace.
"""

import itertools
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from appliance.master.endpoints.delivery import Delivery, NodeCall
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import Grants
from appliance.master.graph.registry import ENDED, Change, Incarnation, Kind, Life, RegistrationKey, Registry
from appliance.rpc.fair_queue import weigh
from appliance.specifications.allocation import TOPIC
from appliance.store.state_file import PermissionRow
from roswire.parameter_tree import Tree, same_value, standing_at
from roswire.xmlrpc import Value

_MAX_PARTS = 1000  # of a change, for a node whose subscriptions are unknown


@dataclass(frozen=True, slots=True)
class Subscribers:
    """Sends nodes the lists and values that they subscribed to."""

    registry: Registry
    grants: Grants
    relay: RelayControl
    delivery: Delivery
    tree: Callable[[], Tree]
    may_read_value: Callable[[Incarnation, str, Value], bool]
    may_know_value: Callable[[Incarnation, str, Value], bool]
    """Like `may_read_value`, for a node that has perhaps never asked: without a record."""
    _valued: dict[Incarnation, set[str]] = field(default_factory=dict, init=False)
    """The parameters whose value each node has; `delivery` keeps the lists."""
    unasked: set[Incarnation] = field(default_factory=set, init=False)
    """Nodes whose subscriptions to parameters are unknown, because another master had them: they get each change."""

    def flush(self, changed: Iterable[Change]) -> None:
        topics: dict[str, None] = {}
        for change in changed:
            match change:
                case Incarnation():
                    topics |= dict.fromkeys(change.resources(Kind.PUBLICATION))
                    self._state_node(change)
                case RegistrationKey(_node, Kind.PUBLICATION, topic):
                    topics[topic] = None
                case RegistrationKey(node, kind, resource):
                    self._state(node, kind, resource)
        for topic in topics:
            for subscriber in self.registry.registrants(Kind.SUBSCRIPTION, topic):
                self._state(subscriber, Kind.SUBSCRIPTION, topic)

    def _state_node(self, node: Incarnation) -> None:
        if node.life is Life.LIVE:
            for kind, resource in (*node.registrations, *node.shelf):
                self._state(node, kind, resource)
            return
        self._valued.pop(node, None)
        self.delivery.drop(node)
        holder = self.registry.occupant(node.name)
        same = holder is not None and holder.api_text == node.api_text  # its machine has another address
        if node.life is Life.REPLACED and not same:
            reason = f"[{node.name}] Reason: new node registered with same name"
            self.delivery.push(node, NodeCall("shutdown", (reason,)))

    def _state(self, node: Incarnation, kind: Kind, resource: str, *, again: bool = False) -> None:
        if node.life is not Life.LIVE:
            return
        if kind is Kind.PARAMETER:
            self._state_value(node, resource)
        elif kind is Kind.SUBSCRIPTION:
            wanted = self._wanted(node, resource)
            if wanted is None:
                self.delivery.drop_list(node, resource)
            elif again or self.delivery.list_of(node, resource) != wanted:
                self.delivery.push_list(node, resource, wanted)

    def _wanted(self, node: Incarnation, topic: str) -> tuple[str, ...] | None:
        if (Kind.SUBSCRIPTION, topic) in node.registrations:
            return self.publishers_for(node, topic)
        return () if (Kind.SUBSCRIPTION, topic) in node.shelf else None

    def _state_value(self, node: Incarnation, key: str) -> None:
        valued = self._valued.setdefault(node, set())
        if (Kind.PARAMETER, key) not in node.registrations:
            valued.discard(key)
        elif key not in valued:
            valued.add(key)
            self._tell_parameter(node, key)

    def publishers_for(self, subscriber: Incarnation, topic: str) -> tuple[str, ...]:
        hidden = self.relay.hides_publishers(topic)
        return self.registry.uris_for(subscriber, Kind.PUBLICATION, topic, hidden=hidden)

    # --- lists of publishers ---

    def list_for(self, subscriber: Incarnation, topic: str) -> tuple[str, ...]:
        uris = self.publishers_for(subscriber, topic)
        self.delivery.answered(subscriber, topic, uris)
        return uris

    def remind_all(self, concerned: Callable[[str], bool] = lambda _topic: True) -> None:
        """Send the lists of all `concerned` topics again: after a rebuild, or when a relay or control is new.

        The empty list of a revoked topic is sent again, because control may have died before it was delivered.
        """
        for node in self.registry.live():
            for kind, topic in (*node.registrations, *node.shelf):
                if kind is Kind.SUBSCRIPTION and concerned(topic):
                    self.remind(node, topic)

    def remind(self, subscriber: Incarnation, topic: str) -> None:
        self._state(subscriber, Kind.SUBSCRIPTION, topic, again=True)

    def remind_besides(self, subscriber: Incarnation, topic: str, uris: Iterable[str]) -> None:
        """Send a list with these URIs beside the publishers: a node keeps its connections until the new ones stand."""
        wanted = self._wanted(subscriber, topic) if subscriber.life is Life.LIVE else None
        if wanted is not None:
            self.delivery.push_list(subscriber, topic, tuple(dict.fromkeys((*wanted, *uris))))

    def renew_all(self, topic: str) -> None:
        """Have every subscriber drop a topic's publishers and connect again, at their new ports."""
        publishers = list(self.registry.registrants(Kind.PUBLICATION, topic))
        for subscriber in self.registry.registrants(Kind.SUBSCRIPTION, topic):
            self.renew(subscriber, topic, publishers)

    def renew(self, subscriber: Incarnation, topic: str, absent: Collection[Incarnation]) -> None:
        """Have a subscriber drop these publishers first, because roscpp ignores an unchanged list."""
        if absent:
            gone = frozenset(publisher.outer_uri(subscriber.told) for publisher in absent)
            self.delivery.remove_first(subscriber, topic, gone)
        self.remind(subscriber, topic)

    def absent(
        self, subscribers: Iterable[Incarnation]
    ) -> Iterator[tuple[Incarnation, str, list[Incarnation]]]:
        """Yield subscribers and topics, with the publishers to which the subscriber is not connected.

        Grants do not matter: if one was withdrawn unnoticed, the subscriber asks again only after dropping the
        publisher.
        """
        used = self.grants.used()
        for subscriber in subscribers:
            for topic in subscriber.resources(Kind.SUBSCRIPTION):
                publishers = [
                    publisher
                    for publisher in self.registry.registrants(Kind.PUBLICATION, topic)
                    if publisher is not subscriber
                    and (publisher.own or subscriber.own or self.relay.carries_topic(topic))
                    and PermissionRow(publisher.key, TOPIC, topic, str(subscriber.host), subscriber.name)
                    not in used
                ]
                if publishers:
                    yield subscriber, topic, publishers

    # --- values of parameters ---

    def value_given(self, subscriber: Incarnation, key: str) -> None:
        self._valued.setdefault(subscriber, set()).add(key)

    def parameter_set(self, key: str, value: Value, caller_id: str | None, before: Value) -> None:
        """Send a value to the subscribers: {} if it was deleted; `before` is the earlier one, or None.

        The node that set it gets no update of the same key.
        """
        if self.unasked:
            self._tell_unasked(key, value, caller_id, before)
        if not self.registry.tells_parameters:
            return
        calls: dict[str, NodeCall] = {}
        for update in updates_of(key, value, self.registry.subscribed_below(key)):
            for subscriber in self.registry.registrants(Kind.PARAMETER, update.subscribed):
                if update.key == key and subscriber.name == caller_id:
                    continue
                if update.key not in calls:
                    calls[update.key] = _param_update(update.key, settled(update.value))
                if self.may_read_value(subscriber, update.key, update.value):
                    self.delivery.push(subscriber, calls[update.key])

    def _tell_unasked(self, key: str, value: Value, caller_id: str | None, before: Value) -> None:
        """Send what changed, and each part of a namespace, because roscpp caches the parts by their own keys."""
        changes = [*itertools.islice(_changes_of(key, value, before), _MAX_PARTS)]
        for node in [*self.unasked]:
            if node.life in ENDED:
                self.unasked.discard(node)
            if node.life is not Life.LIVE or node.name == caller_id:
                continue
            for changed, part in changes:
                told = (Kind.PARAMETER, changed) in node.registrations
                if not told and self.may_know_value(node, changed, part):
                    self.delivery.push_unasked(node, changed, _param_update(changed, settled(part)))

    def tell_parameters(self, subscriber: Incarnation) -> None:
        for key in subscriber.resources(Kind.PARAMETER):
            self._tell_parameter(subscriber, key)

    def _tell_parameter(self, subscriber: Incarnation, key: str) -> None:
        """Send the present value if the node may still read it: the subscription was decided by earlier keys."""
        present, _ = standing_at(self.tree(), key)
        value = {} if present is None else settled(present)
        if self.may_read_value(subscriber, key, value):
            self.delivery.push(subscriber, _param_update(key, value))


def _param_update(key: str, value: Value) -> NodeCall:
    """Like the ROS master, end the key with `/`, and send `{}` for an unset key."""
    return NodeCall("paramUpdate", (f"{key.rstrip('/')}/", value), weigh(value, sys.maxsize))


class ParameterUpdate(NamedTuple):
    """Subscribers to `subscribed` get this value of `key`."""

    subscribed: str
    key: str
    value: Value


def updates_of(key: str, value: Value, below: Iterable[str]) -> Iterator[ParameterUpdate]:
    """Yield the updates for a new value (`{}` if deleted). `below` are the subscribed keys below `key`."""
    for above in _upwards(key):
        yield ParameterUpdate(above, key, value)
    if isinstance(value, dict):
        for subscribed in below:
            yield ParameterUpdate(
                subscribed, subscribed, _member(value, subscribed[len(key.rstrip("/")) + 1 :])
            )


def settled(value: Value) -> Value:
    """Copy the namespaces of a value, because later calls change them in place."""
    return {name: settled(member) for name, member in value.items()} if isinstance(value, dict) else value


def _changes_of(key: str, value: Value, before: Value) -> Iterator[tuple[str, Value]]:
    """Yield the keys whose values differ, from the top; `{}` for a key that is gone."""
    if same_value(value, before):
        return
    yield key, value
    now, then = (part if isinstance(part, dict) else {} for part in (value, before))
    for name in {**then, **now}:
        yield from _changes_of(f"{key.rstrip('/')}/{name}", now.get(name, {}), then.get(name))


def _upwards(key: str) -> Iterator[str]:
    while key != "/":
        yield key
        key = key.rpartition("/")[0] or "/"
    yield key


def _member(value: Value, path: str) -> Value:
    for part in path.split("/"):
        if not isinstance(value, dict) or part not in value:
            return {}
        value = value[part]
    return value
