"""The gate decides on parameters (the key, all keys below it, replaced values) and on names in use."""

import ipaddress
from typing import Any

import pytest

from appliance.master.caller import ApiUri, Caller
from appliance.master.calls.call import CALLER_API, SERVICE_API, Attempt, Identity, RosCall
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.gate import CallGate, HostLimits, NameConflict, contested
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.master.graph.registry import PUBLISHER_PATH, Incarnation, Kind, Registry
from appliance.master.reconcile.liveness import Presence, Probe
from appliance.policy.model import Decision
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.server import Peer
from roswire.parameter_tree import Tree
from roswire.uris import parse_node_uri, parse_service_uri

ADMIN, OPERATOR = "10.0.0.9", "10.0.0.5"
BASE = """
[Groups]
ocu = 10.0.0.5
adm = 10.0.0.9
[Nodes]
default = *
[Commands]
default = *
[Parameters]
"""
LIMITED = """
read default   = *
write default  = adm
write /arm/**  = adm ocu
write /arm/max = adm
"""
EXACT = """
read /arm      = ocu
read default   = adm
write /arm     = ocu
write default  = adm
"""


def gate(rules: str) -> CallGate:
    """Return the gate under a policy with these rules for parameters, without registrations."""
    policy = compile_policy(BASE + rules, file="test.ini")
    return CallGate(lambda: policy, Registry(), HostLimits())


def ask(rules: str, host: str, method: str, *arguments: Any, tree: Any = None) -> Decision:
    """Return the decision on a call while the ROS master has the parameters `tree`."""
    peer = Peer(ipaddress.ip_address(host), host, "10.0.0.1")
    decision = gate(rules).decide(
        Attempt(Caller(peer, "/me", 0), MASTER_CALLS[method], arguments), tree or {}
    )
    assert not isinstance(decision, NameConflict)
    return decision


@pytest.mark.parametrize("key", ["/arm/max/x", "/arm/max/x/y"])
def test_a_value_that_may_not_be_written_is_not_replaced_from_below(key: str) -> None:
    """Setting a key below a value turns the value into a namespace, so it needs the right to write the value."""
    tree = {"arm": {"max": 5, "speed": 1}}
    denied = ask(LIMITED, OPERATOR, "setParam", key, 0, tree=tree)
    assert not denied.allowed
    assert denied.rule is not None
    assert denied.rule.key == "write /arm/max"
    assert "/arm/max" in denied.reason
    assert ask(LIMITED, ADMIN, "setParam", key, 0, tree=tree).allowed
    assert ask(LIMITED, OPERATOR, "setParam", "/arm/speed/x", 0, tree=tree).allowed


def test_only_a_value_blocks_a_write_below_it() -> None:
    """Below a namespace, or below an unset key, the right to the key itself decides."""
    trees: list[Tree] = [{}, {"arm": {}}, {"arm": {"max": {"y": 1}}}]
    for tree in trees:
        assert ask(LIMITED, OPERATOR, "setParam", "/arm/max/x", 0, tree=tree).allowed


@pytest.mark.parametrize(
    ("method", "arguments"),
    [("getParam", ("/arm",)), ("hasParam", ("/arm",)), ("setParam", ("/arm", 0)), ("deleteParam", ("/arm",))],
)
def test_an_exact_key_does_not_grant_its_namespace(method: str, arguments: tuple[Any, ...]) -> None:
    """While /arm is a value, `/arm = ocu` applies; members of a namespace /arm are decided by `default`."""
    assert ask(EXACT, OPERATOR, method, *arguments, tree={"arm": 7}).allowed
    assert ask(EXACT, OPERATOR, method, *arguments, tree={}).allowed
    denied = ask(EXACT, OPERATOR, method, *arguments, tree={"arm": {"speed": 7}})
    assert not denied.allowed
    assert denied.rule is not None
    assert denied.rule.key.endswith(" default")


def test_a_dictionary_is_a_namespace_before_it_is_there() -> None:
    """A host that sets a dictionary needs the right to each of its members."""
    assert not ask(EXACT, OPERATOR, "setParam", "/arm", {"speed": 1}).allowed
    assert ask(EXACT + "write /arm/** = ocu\n", OPERATOR, "setParam", "/arm", {"speed": 1}).allowed
    assert ask(EXACT, OPERATOR, "setParam", "/arm", [{"speed": 1}]).allowed


def test_without_the_section_commands_decide() -> None:
    """Without [Parameters], [Commands] alone decides on parameter calls."""
    rules = "[Clients]\ndefault = *\n"
    tree: Tree = {"arm": {"max": 5}}
    text = BASE.replace("[Parameters]\n", "") + rules
    policy = compile_policy(text, file="test.ini")
    peer = Peer(ipaddress.ip_address(OPERATOR), OPERATOR, "10.0.0.1")
    here = CallGate(lambda: policy, Registry(), HostLimits())
    decision = here.decide(Attempt(Caller(peer, "/me", 0), MASTER_CALLS["setParam"], ("/arm/max/x", 0)), tree)
    assert isinstance(decision, Decision)
    assert decision.allowed


API = "http://127.0.0.1:4000/"


def held(name: str, host: str, *, own: bool) -> Registry:
    """Return a registry in which a node of this host holds `name`; with `own`, it is the appliance's node."""
    registry = Registry()
    address, uri = ipaddress.ip_address(host), parse_node_uri(API)
    node = Incarnation("key", name, address, uri, API, host, 19001, 19002, own=own)
    registry.add(node)
    registry.register(node, Kind.PUBLICATION, "/rosout_agg", "rosgraph_msgs/Log")
    return registry


@pytest.mark.parametrize(
    ("method", "arguments", "does"),
    [
        ("registerPublisher", ("/rosout_agg", "rosgraph_msgs/Log", API), True),
        ("unregisterPublisher", ("/rosout_agg", API), True),
        ("setParam", ("/key", 1), False),
    ],
)
def test_names_of_the_appliance_are_its_own_on_its_own_machine_too(
    method: str, arguments: tuple[Any, ...], does: bool
) -> None:
    """Without isolation the robot's nodes and the appliance's have the same address: the listener separates them.

    The policy does not apply at the listener of the appliance's node, whose allowed actions are known (`does`).
    """
    policy = compile_policy(
        "[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n[Commands]\ndefault = *\n", file="test.ini"
    )
    loopback = Peer(ipaddress.ip_address("127.0.0.1"), "127.0.0.1", "127.0.0.1")
    call = MASTER_CALLS[method]
    given = tuple(ApiUri(API, parse_node_uri(API)) if one == API else one for one in arguments)
    for own in (True, False):
        registry = held("/rosout", "127.0.0.1", own=own)
        here = CallGate(lambda: policy, registry, HostLimits())
        decision = here.decide(Attempt(Caller(loopback, "/rosout", 0), call, given), {})
        assert isinstance(decision, Decision)
        assert decision.allowed is not own
        itself = here.decide(Attempt(Caller(loopback, "/rosout", 0, own=True), call, given), {})
        assert isinstance(itself, Decision)
        assert itself.allowed is does


@pytest.mark.parametrize(
    "call",
    [one for one in (*MASTER_CALLS.values(), *NODE_CALLS.values()) if one.identity is not Identity.NOBODY],
    ids=lambda one: one.name,
)
def test_no_call_is_made_under_the_name_of_another_hosts_node(call: RosCall[Any]) -> None:
    """No policy grants such a call; a registration waits until the present holder is probed."""
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
    """As in plain ROS, the last registration of a service wins, except for the appliance's services."""
    policy = compile_policy("[Nodes]\ndefault = *\n", file="test.ini")
    registry = Registry()
    uri, robot = f"http://127.0.0.1:4000{path}", ipaddress.ip_address("10.0.0.5")
    home = ipaddress.ip_address("127.0.0.1")
    node = Incarnation(
        "key", "/rosrv", home, parse_node_uri(uri), uri, str(home), 19001, 19002, own=path != "/"
    )
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
    """The rosout aggregator subscribes at other nodes' proxy endpoints, even if the policy gives this machine no right.

    Other machines may not use the aggregator's name, and on this machine the name grants nothing else.
    """
    policy = compile_policy(
        f"[Nodes]\ndefault = {OPERATOR}\n[Subscribers]\ndefault = {OPERATOR}\n", file="p.ini"
    )
    registry = held("/rosout", "127.0.0.1", own=True)
    aggregator = registry.holder("/rosout")
    assert aggregator is not None
    registry.register(aggregator, Kind.SUBSCRIPTION, "/rosout", "rosgraph_msgs/Log")
    here = CallGate(lambda: policy, registry, HostLimits())
    uri = parse_node_uri(API)
    other = Incarnation("other", "/voice", ipaddress.ip_address(OPERATOR), uri, API, OPERATOR, 19003, 19004)
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


@pytest.mark.parametrize(
    ("presence", "words"),
    [
        (Presence.GONE, None),
        (
            Presence.SILENT,
            "does not answer (it hangs, or was stopped); unless it answers it is unregistered in 8 s",
        ),
        (Presence.ANSWERS, "is held by a running node on 10.0.0.9"),
    ],
)
def test_a_contest_ends_as_the_probe_found_the_holder(presence: Presence, words: str | None) -> None:
    """If the holder is gone, the name is free; if it is silent, the refusal says when to retry."""
    holder, other = (next(iter(held(name, "10.0.0.9", own=False).live())) for name in ("/voice", "/other"))
    contest = NameConflict(holder, Decision(True, None, "granted"))
    decision = contested(contest, Probe(holder, presence, 7.2))
    assert (decision.allowed, words is None or words in decision.reason) == (words is None, True)
    assert not contested(contest, Probe(other, presence, 7.2)).allowed
    assert not contested(contest, None).allowed


def test_a_host_has_as_many_registrations_as_are_left() -> None:
    """Even if every host registers as many topics as it can, enough remain for the next host."""
    policy = compile_policy(BASE + LIMITED + "[Publishers]\ndefault = *\n", file="test.ini")
    registry = Registry()
    limits = HostLimits(nodes=500, registrations=60, registrations_in_all=100)
    gate = CallGate(lambda: policy, registry, limits)
    counts = []
    for number in range(4):
        host, uri = f"10.1.0.{number}", f"http://10.1.0.{number}:4000/"
        caller = Caller(Peer(ipaddress.ip_address(host), host, "10.0.0.1"), f"/n{number}", 0)
        api = ApiUri(uri, parse_node_uri(uri))
        node = Incarnation(f"k{number}", f"/n{number}", caller.peer.host, api.uri, uri, "", 1, 2)
        registry.add(node)
        for turn in range(100):
            call = MASTER_CALLS["registerPublisher"]
            decision = gate.decide(Attempt(caller, call, (f"/t{turn}", "std_msgs/String", api)), {})
            assert isinstance(decision, Decision)
            if not decision.allowed:
                assert "registrations" in decision.reason
                break
            registry.register(node, Kind.PUBLICATION, f"/t{turn}", "std_msgs/String")
        counts.append(registry.registrations_of(caller.peer.host))
    assert counts == [60, 30, 8, 2]
