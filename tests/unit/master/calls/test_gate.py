import ipaddress
from typing import Any

import pytest

from appliance.master.calls.call import CALLER_API, SERVICE_API, ApiUri, Attempt, Caller, RosCall
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.gate import CallGate, HostLimits, NameConflict, decide_contest
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.master.graph.registry import PUBLISHER_PATH, Incarnation, Kind, Registry
from appliance.master.reconcile.liveness import Presence, Probe
from appliance.policy.model import Decision
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.server import Peer
from roswire.uris import parse_node_uri, parse_service_uri
from tests.support.incarnations import incarnation

ADMIN, OPERATOR = "10.0.0.9", "10.0.0.5"
API = "http://127.0.0.1:4000/"


def held(name: str, host: str, *, own: bool) -> Registry:
    registry = Registry()
    node = incarnation(name, host=host, own=own)
    registry.add(node)
    registry.register(node, Kind.PUBLICATION, "/rosout_agg", "rosgraph_msgs/Log")
    return registry


@pytest.mark.parametrize(
    "call",
    [one for one in (*MASTER_CALLS.values(), *NODE_CALLS.values()) if not one.row.wire],
    ids=lambda one: one.name,
)
def test_no_call_is_made_under_the_name_of_another_hosts_node(call: RosCall[Any]) -> None:
    sections = ("Nodes", "Publishers", "Subscribers", "Services", "Clients", "Commands")
    text = "".join(f"[{name}]\ndefault = *\n" for name in sections)
    policy = compile_policy(f"{text}getRVState = *\nshutdownMaster = *\n", file="test.ini")
    uri = f"http://{OPERATOR}:4000/"
    own = ApiUri(uri, parse_node_uri(uri))
    given = tuple(own if one in {CALLER_API, SERVICE_API} else "/thing" for one in call.method.parameters)
    caller = Caller(Peer(ipaddress.ip_address(OPERATOR), OPERATOR, "10.0.0.1"), "/me", 0)
    for host, may in ((OPERATOR, True), (ADMIN, False)):
        here = CallGate(lambda: policy, held("/me", host, own=False), HostLimits())
        decision = here.decide(Attempt(caller, call, given), {})
        assert (isinstance(decision, Decision) and decision.allowed) is may


@pytest.mark.parametrize(("path", "allowed"), [(PUBLISHER_PATH, False), ("/", True)])
def test_no_node_replaces_a_service_of_the_appliance(path: str, allowed: bool) -> None:
    policy = compile_policy("[Nodes]\ndefault = *\n", file="test.ini")
    registry = Registry()
    robot = ipaddress.ip_address("10.0.0.5")
    node = incarnation("/rosrv", host="127.0.0.1", path=path, own=path != "/")
    registry.add(node)
    registry.register(node, Kind.SERVICE, "/rosrv/record_now", "4000")
    caller = Caller(Peer(robot, str(robot), "10.0.0.1"), "/namesake", 0)
    api = ApiUri("http://10.0.0.5:5/", parse_node_uri("http://10.0.0.5:5/"))
    given = (
        "/rosrv/record_now",
        ApiUri("rosrpc://10.0.0.5:6", parse_service_uri("rosrpc://10.0.0.5:6")),
        api,
    )
    attempt = Attempt(caller, MASTER_CALLS["registerService"], given)
    decision = CallGate(lambda: policy, registry, HostLimits()).decide(attempt, {})
    assert isinstance(decision, Decision)
    assert decision.allowed is allowed
    if not allowed:
        assert decision.reason == "the service /rosrv/record_now belongs to the appliance"


def test_the_appliances_nodes_may_ask_others_for_a_topic() -> None:
    """The rosout aggregator subscribes to other nodes' proxy endpoints, even without a right in the policy.

    Other machines must not use the aggregator's name, and on this machine the name grants nothing else.
    """
    policy = compile_policy(
        f"[Nodes]\ndefault = {OPERATOR}\n[Subscribers]\ndefault = {OPERATOR}\n", file="p.ini"
    )
    registry = held("/rosout", "127.0.0.1", own=True)
    aggregator = registry.holder("/rosout")
    assert aggregator is not None
    registry.register(aggregator, Kind.SUBSCRIPTION, "/rosout", "rosgraph_msgs/Log")
    here = CallGate(lambda: policy, registry, HostLimits())
    other = incarnation("/voice", host=OPERATOR, ports=(19003, 19004))
    for host, local, topic, allowed in (
        ("127.0.0.1", "127.0.0.1", "/rosout", True),
        ("10.0.0.1", "10.0.0.1", "/rosout", True),
        ("127.0.0.1", "127.0.0.1", "/chatter", False),
        (OPERATOR, "10.0.0.1", "/rosout", False),
    ):
        caller = Caller(Peer(ipaddress.ip_address(host), host, local), "/rosout", 0, target=other)
        decision = here.decide(Attempt(caller, NODE_CALLS["requestTopic"], (topic, [["TCPROS"]])), {})
        assert isinstance(decision, Decision)
        assert decision.allowed is allowed


def test_only_a_probe_of_the_present_holder_decides_a_contest() -> None:
    holder, other = (next(iter(held(name, ADMIN, own=False).live())) for name in ("/voice", "/other"))
    contest = NameConflict(holder, Decision(True, None, "granted"))
    assert decide_contest(contest, Probe(holder, Presence.GONE, 7.2)).allowed
    assert not decide_contest(contest, Probe(other, Presence.GONE, 7.2)).allowed
    assert not decide_contest(contest, None).allowed


def register(gate: CallGate, number: int, topic: str, name: str) -> Decision:
    host, uri = f"10.1.0.{number}", f"http://10.1.0.{number}:4000{name}"
    caller = Caller(Peer(ipaddress.ip_address(host), host, "10.0.0.1"), name, 0)
    given = (topic, "std_msgs/String", ApiUri(uri, parse_node_uri(uri)))
    decision = gate.decide(Attempt(caller, MASTER_CALLS["registerPublisher"], given), {})
    assert isinstance(decision, Decision)
    return decision


def joined(registry: Registry, number: int, name: str) -> Incarnation:
    host = f"10.1.0.{number}"
    node = incarnation(name, host=host, key=f"{name} of {host}", path=name)
    registry.add(node)
    return node


@pytest.mark.parametrize(
    ("registry", "limits", "words"),
    [
        (
            Registry(3),
            HostLimits(),
            "10.1.0.1 has 3 nodes, the limit for one host: raise limits.nodes_per_host",
        ),
        (
            Registry(),
            HostLimits(registrations=3),
            "10.1.0.1 has 3 registrations, the limit for one host: raise limits.topics_per_host",
        ),
    ],
)
def test_a_host_has_a_limit_of_nodes_and_registrations(
    registry: Registry, limits: HostLimits, words: str
) -> None:
    policy = compile_policy("[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n", file="test.ini")
    gate = CallGate(lambda: policy, registry, limits)
    for number in range(3):
        node = joined(registry, 1, f"/n{number}")
        registry.register(node, Kind.PUBLICATION, "/t", "std_msgs/String")
    assert register(gate, 1, "/t", "/n3").reason == words
    assert register(gate, 2, "/t", "/n3").allowed
    registry.unregister(node, Kind.PUBLICATION, "/t")  # it can be evicted
    assert register(gate, 1, "/t", "/n3").allowed


def test_a_host_has_as_many_registrations_as_are_left() -> None:
    policy = compile_policy("[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n", file="test.ini")
    registry = Registry()
    gate = CallGate(lambda: policy, registry, HostLimits(registrations=60, registrations_in_all=100))
    counts = []
    for number in range(4):
        node = joined(registry, number, f"/n{number}")
        while (decision := register(gate, number, f"/t{registry.registrations}", node.name)).allowed:
            registry.register(node, Kind.PUBLICATION, f"/t{registry.registrations}", "std_msgs/String")
        assert "registrations" in decision.reason
        counts.append(registry.registrations_of(node.host))
    assert counts == [60, 30, 8, 2]
