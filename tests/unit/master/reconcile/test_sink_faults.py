"""Faults of the sinks, which the histories of `sink_history.py` must find. Each replaces a part of a function."""

import inspect
import textwrap
from typing import Any, NamedTuple

import pytest

from appliance.master import rosmaster
from appliance.master.endpoints.relay_control import RelayControl, RelayOutbox
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import ProxyEndpoints, StoredGraph
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import MasterRegistrations
from tests.support.examples import sample
from tests.unit.master.reconcile.sink_history import history, live

pytestmark = pytest.mark.timeout(60)
_SEEDS = 500


class Fault(NamedTuple):
    """The replacement of `text`, which occurs once in the function `name` of a class or module, with `wrong`."""

    place: Any
    name: str
    text: str
    wrong: str


FAULTS = {
    # the store
    "a forgotten node stays stored": Fault(StoredGraph, "_save", "self.store.forget_incarnation(change.key)", "pass"),
    "a node is not stored": Fault(StoredGraph, "_save", "self.store.save_incarnation(", "(lambda *_: None)("),
    "an ended registration stays stored": Fault(
        StoredGraph, "_save", "self.store.remove_registration(node.key, stored_kind, resource)", "pass"
    ),
    "a registration is not stored": Fault(StoredGraph, "_save", "self.store.save_registration(", "(lambda *_: None)("),
    "a withdrawn registration is stored as in force": Fault(
        StoredGraph, "_save", "if shelved else kind.value", "if 0 else kind.value"
    ),
    "an ended grant stays stored": Fault(StoredGraph, "_save", "self.store.remove_permission(change)", "pass"),
    "a grant is not stored": Fault(StoredGraph, "_save", "self.store.save_permission(change)", "pass"),
    "only a part of a long turn is stored": Fault(StoredGraph, "flush", "begin + _TOGETHER", "begin + 1"),
    # the nodes
    "a list is not compared": Fault(Subscribers, "_state", "!= wanted", "is not wanted"),
    "a list is sent only once": Fault(Subscribers, "_state", "!= wanted", "is None"),
    "a sent value is not noted": Fault(Subscribers, "_state_value", "valued.add(key)", "pass"),
    "the value of a parameter is not sent": Fault(
        Subscribers, "_state_value", "self._tell_parameter(node, key)", "pass"
    ),
    "a parameter that ended counts as sent": Fault(
        Subscribers, "_state_value", "valued.discard(key)", "pass"
    ),
    "a node that ended has its values": Fault(
        Subscribers, "_state_node", "self._valued.pop(node, None)", "pass"
    ),
    "a node that returns gets nothing": Fault(
        Subscribers, "_state_node", "(*node.registrations, *node.shelf)", "()"
    ),
    "a node that returns gets no withdrawn topic": Fault(
        Subscribers, "_state_node", "(*node.registrations, *node.shelf)", "node.registrations"
    ),
    "a replaced node is not shut down": Fault(
        Subscribers, "_state_node", "life is Life.REPLACED", "life is None"
    ),
    "calls wait for a node that ended": Fault(
        Subscribers, "_state_node", "self.delivery.drop(node)", "pass"
    ),
    "the end of a publisher is not told": Fault(Subscribers, "flush", "topics |= ", "_ = "),
    "a new publication is not told": Fault(Subscribers, "flush", "topics[topic] = None", "pass"),
    "a changed node is not told": Fault(Subscribers, "flush", "self._state_node(change)", "pass"),
    "a changed subscription is not told": Fault(
        Subscribers, "flush", "self._state(node, kind, resource)", "pass"
    ),
    "a withdrawn topic keeps its list": Fault(Subscribers, "_wanted", "in node.shelf", "in ()"),
    "a subscription has an empty list": Fault(
        Subscribers, "_wanted", "return self.publishers_for(node, topic)", "return ()"
    ),
    "a list waits for a subscription that ended": Fault(
        Subscribers, "_state", "self.delivery.drop_list(node, resource)", "pass"
    ),
    "an older list follows the answer": Fault(
        Subscribers, "list_for", "self.delivery.answered(subscriber, topic, uris)", "pass"
    ),
    "a value in an answer is sent again": Fault(
        Subscribers, "value_given", "self._valued.setdefault(subscriber, set()).add(key)", "pass"
    ),
    "a new ROS master sends no lists": Fault(
        Subscribers, "remind", "again=True", "again=False"
    ),
    "a new ROS master sends no empty lists": Fault(
        Subscribers, "remind_all", "(*node.registrations, *node.shelf)", "node.registrations"
    ),
    # the ROS master
    "a registration is not compared": Fault(
        MasterRegistrations, "_compare", "self.wanted(key) == self._stated.get(key)", "False"
    ),
    "a registration that is undone stays different": Fault(
        MasterRegistrations, "_compare", "self._differing.pop(key, None)", "pass"
    ),
    "no difference is noted": Fault(MasterRegistrations, "_compare", "self._differing[key] = None", "pass"),
    "a lost node stays registered": Fault(
        MasterRegistrations, "flush", "self._compare((kind, resource, change.name))", "pass"
    ),
    "a changed registration is not forwarded": Fault(
        MasterRegistrations, "flush", "self._compare((change.kind, change.resource, change.node.name))", "pass"
    ),
    "a forwarded registration is not noted": Fault(
        MasterRegistrations, "take", "self._stated[key] = wanted", "pass"
    ),
    "an ended registration is not noted": Fault(
        MasterRegistrations, "take", "self._stated.pop(key, None)", "self._stated.get(key)"
    ),
    "a new ROS master counts as the old one": Fault(
        MasterRegistrations, "adopt", "dict(seen)", "{**self._stated, **seen}"
    ),
    "a new ROS master gets nothing": Fault(
        MasterRegistrations, "adopt", "self._compare((registration.kind, registration.resource, node.name))", "pass"
    ),
    "a parameter is forwarded": Fault(MasterRegistrations, "wanted", "or kind is Kind.PARAMETER", ""),
    "any node of the name counts": Fault(
        MasterRegistrations, "wanted", "self._registry.holder(name)",
        "next((one for one in self._registry.all() if one.name == name), None)",
    ),
    "a service has the type of a topic": Fault(
        MasterRegistrations, "wanted", "stand_in(node) if service else registration.detail", "registration.detail"
    ),
    "a later life gets no registration": Fault(
        rosmaster, "_calls", "if wanted is not None:", "if wanted is not None and stated is None:"
    ),
    "an earlier life stays registered": Fault(rosmaster, "_calls", "stated is not None and (", "False and ("),
    # the relays
    "a fact is not compared": Fault(RelayControl, "_state_fact", "wanted == before or", ""),
    "a stated fact is not noted": Fault(
        RelayControl, "_state_fact", "post.stated[node.key][fact] = wanted", "post.stated[node.key].setdefault(fact)"
    ),
    "a withdrawn fact is not noted": Fault(
        RelayControl, "_state_fact", "del post.stated[node.key][fact]", "pass"
    ),
    "a fact is not withdrawn": Fault(
        RelayControl, "_state_fact", "post.send(messages.FactWithdrawn(messages.identity(before)), soon=soon)", "pass"
    ),
    "a fact is stated without its node": Fault(
        RelayControl, "_state_fact", "self._place_node(post, node)", "post.stated[node.key] = {}"
    ),
    "a node that ended is not withdrawn": Fault(
        RelayControl, "_state_node", "post.send(messages.FactWithdrawn((\"node\", node.key)))", "pass"
    ),
    "a node that ended has its facts": Fault(
        RelayControl, "_state_node", "del post.stated[node.key]", "pass"
    ),
    "a node that returns is placed nowhere": Fault(
        RelayControl, "_state_node", "self._state(post, RegistrationKey(node, kind, resource))", "pass"
    ),
    "a node that returns has no clients": Fault(
        RelayControl, "_state_node", "self._state(post, row)", "pass"
    ),
    "a withdrawn registration is stated": Fault(
        RelayControl, "_state", "kind in _WORDS and not shelved", "kind in _WORDS and shelved"
    ),
    "a grant is not stated": Fault(
        RelayControl, "_state", "if provider is not None:", "if False:"
    ),
    "a new relay counts as the old one": Fault(RelayOutbox, "close", "self.stated.clear()", "pass"),
    "a lost publisher is placed": Fault(RelayControl, "_placed", "if node.life is Life.LIVE else None", ""),
    "a service is stated as a topic": Fault(
        RelayControl, "_placed", "if kind is Kind.SERVICE:", "if False:"
    ),
    "a lost provider has clients": Fault(RelayControl, "_granted", "node.life is Life.LIVE and", ""),
    "a revoked grant is stated": Fault(RelayControl, "_granted", "and row in self.grants.of(row.key)", ""),
    "a grant for a service is one for a topic": Fault(
        RelayControl, "_granted", "if row.kind == SERVICE:", "if False:"
    ),
    "a new policy is not stated": Fault(RelayControl, "compare", "self.registry.live()", "[]"),
    "no change is tried": Fault(
        RelayControl, "_state_all", "post.unstated |= dict.fromkeys(changes)", "pass"
    ),
    # the turn
    "a node that ended keeps its ports": Fault(ProxyEndpoints, "flush", "self.close(node)", "pass"),
    "a replaced node keeps its ports": Fault(
        ProxyEndpoints, "flush", "in ENDED", "is Life.FORGOTTEN"
    ),
    "a change is not noted": Fault(
        Registry, "mark", "self._changed[change] = None", "self._changed.setdefault(0)"
    ),
    "an address is not noted": Fault(Registry, "reached_at", "self.mark(incarnation)", "pass"),
}  # fmt: skip


def faulty(fault: Fault) -> Any:
    function = inspect.unwrap(getattr(fault.place, fault.name))
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(fault.text) == 1, f"{fault.name} has {fault.text!r} {source.count(fault.text)} times"
    source = source.replace(fault.text, fault.wrong).replace(
        "super()", f"super({fault.place.__name__}, self)"
    )
    names: dict[str, Any] = {}
    exec(compile(source, fault.name, "exec"), function.__globals__, names)  # noqa: S102  a fault of our own source
    return names[fault.name]


def test_each_fault_has_its_place() -> None:
    assert all(faulty(fault) for fault in FAULTS.values())


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", sample([*FAULTS], 11))
def test_each_fault_of_a_sink_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fault = FAULTS[name]
    monkeypatch.setattr(fault.place, fault.name, faulty(fault))

    with pytest.raises((AssertionError, KeyError)):
        for seed in range(_SEEDS):
            live(history(seed))
