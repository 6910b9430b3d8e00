"""The gate, `explain`, the cases, `diff`, `grant` and revocation agree on each call.

`NEEDS` lists the rights for each call independently, by section, like docs/policy.md.
"""

import ipaddress
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.features.policy_tools.decision_reasons import explain
from appliance.features.policy_tools.diff import diff
from appliance.features.policy_tools.grant import DecidedRequest, UngrantableError, grant
from appliance.master.calls.call import (
    CALLER_API,
    KEY,
    SERVICE_API,
    TOPIC,
    ApiUri,
    Attempt,
    Caller,
    CallParameter,
    CallVerb,
    RosCall,
    method,
)
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.gate import CallGate, HostLimits, NameConflict
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.node_calls import NODE_CALLS
from appliance.master.graph.registry import Incarnation, Kind, Registry, new_key
from appliance.master.graph.revocation import CALLS
from appliance.policy.actions import VERBS
from appliance.policy.cases import run_cases
from appliance.policy.commands import COMMANDS
from appliance.policy.judgement import PolicyContext
from appliance.policy.live_rights import LiveRight, may_keep
from appliance.policy.model import Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.rights import needs_node, rights_of
from appliance.rpc.server import Peer
from roswire.parameter_tree import Tree
from roswire.uris import parse_node_uri
from tests.support.control_parts import ControlParts
from tests.support.examples import examples

HOST = ipaddress.ip_address("10.0.0.5")
NAME, THING, KEY_GIVEN = "/me", "/thing", "/arm/speed"
URI = "http://10.0.0.5:4000/"
ROWS = [*MASTER_CALLS.values(), *NODE_CALLS.values()]
SECTIONS = ("Nodes", "Publishers", "Subscribers", "Services", "Clients", "read", "write", "Commands")
# The sections that decide on a call; every call that is not listed needs [Commands] under its own name.
NEEDS = {
    "registerPublisher": ("Publishers", "Nodes"),
    "unregisterPublisher": ("Publishers", "Nodes"),
    "registerSubscriber": ("Subscribers", "Nodes"),
    "unregisterSubscriber": ("Subscribers", "Nodes"),
    "requestTopic": ("Subscribers", "Nodes"),
    "registerService": ("Services", "Nodes"),
    "unregisterService": ("Services", "Nodes"),
    "lookupService": ("Clients", "Commands"),
    "getParam": ("Commands", "read"),
    "hasParam": ("Commands", "read"),
    "setParam": ("Commands", "write"),
    "deleteParam": ("Commands", "write"),
    "subscribeParam": ("Commands", "read", "Nodes"),
    "unsubscribeParam": ("Commands", "read", "Nodes"),
}
EXTENSIONS = {"Services", "Clients", "read", "write"}  # a policy without these sections allows such calls
GRANTS = {
    Kind.PUBLICATION: "registerPublisher",
    Kind.SUBSCRIPTION: "registerSubscriber",
    Kind.SERVICE: "registerService",
    Kind.PARAMETER: "subscribeParam",
}
GIVES_UP = {
    "unregisterPublisher": Kind.PUBLICATION,
    "unregisterSubscriber": Kind.SUBSCRIPTION,
    "unregisterService": Kind.SERVICE,
    "unsubscribeParam": Kind.PARAMETER,
}
SAID = {category: verb for verb, category in VERBS.items()}


def text_of(granted: frozenset[str], missing: frozenset[str], keyed: bool) -> str:
    lines: dict[str, list[str]] = {}
    for section in SECTIONS:
        verb = f"{section} " if section in {"read", "write"} else ""
        title = "Parameters" if verb else section
        if section in missing or (verb and {"read", "write"} & missing):
            continue
        keys = ["default", f"{verb}default"][bool(verb) : bool(verb) + 1]
        if keyed and not verb and section != "Commands":
            keys.append(NAME if section == "Nodes" else THING)
        if section == "Commands":
            keys += ["getRVState", "shutdownMaster"]
        who = "10.0.0.5 10.0.0.9" if section in granted else "10.0.0.9"
        lines.setdefault(title, []).extend(f"{key} = {who}" for key in keys)
    return "".join(f"[{title}]\n" + "\n".join(rules) + "\n" for title, rules in lines.items())


def argument_of(parameter: CallParameter[Any]) -> Any:
    if parameter in {CALLER_API, SERVICE_API}:
        return ApiUri(URI, parse_node_uri(URI))
    return KEY_GIVEN if parameter is KEY else THING


def gate_says(policy: Policy, call: RosCall[Any], tree: Tree) -> Decision:
    gate = CallGate(lambda: policy, Registry(), HostLimits())
    name = "" if call.row.wire else NAME
    arguments = tuple(argument_of(parameter) for parameter in call.method.parameters)
    caller = Caller(Peer(HOST, str(HOST), "10.0.0.1"), name, 0)
    decision = gate.decide(Attempt(caller, call, arguments), tree)
    assert not isinstance(decision, NameConflict)
    return decision


def needed(call: RosCall[Any], missing: frozenset[str]) -> list[str]:
    free = EXTENSIONS & (missing | ({"read", "write"} if {"read", "write"} & missing else set()))
    return [section for section in NEEDS.get(call.name, ("Commands",)) if section not in free]


def deeds(call: RosCall[Any]) -> list[Request]:
    category = call.row.category
    name = call.policy_name if category is Category.COMMAND else THING
    found = [Request(HOST, NAME, category, name)]
    if call.row.touches is not None:
        found.append(Request(HOST, NAME, call.row.touches, KEY_GIVEN))
    return found


def case_passes(policy: Policy, request: Request, allowed: bool) -> bool:
    word = "allow" if allowed else "deny"
    deed = f"{SAID[request.category]} {request.resource}"
    text = f"cases:\n- host: {request.host}\n  node: {NAME}\n  {word}: ['{deed}']\n"
    return all(case.passed for case in run_cases(policy, text, "cases"))


@settings(max_examples=examples(150), suppress_health_check=[HealthCheck.too_slow])
@given(
    st.frozensets(st.sampled_from(SECTIONS)),
    st.frozensets(st.sampled_from(SECTIONS), max_size=2),
    st.booleans(),
)
def test_all_parts_decide_alike(granted: frozenset[str], missing: frozenset[str], keyed: bool) -> None:
    policy = compile_policy(text_of(granted, missing, keyed), file="policy")
    nobody = compile_policy("[Nodes]\n", file="nobody")
    for call in ROWS:
        verdict = gate_says(policy, call, {}).allowed
        assert verdict == all(one in granted - missing for one in needed(call, missing)), call.name
        explained = {request: explain(policy, request).allowed for request in deeds(call)}
        assert verdict == all(explained.values()), call.name
        for request, allowed in explained.items():
            assert case_passes(policy, request, allowed), request
            assert not case_passes(policy, request, not allowed), request
            differs = diff(policy, nobody, [request])
            assert bool(differs) == (allowed != explain(nobody, request).allowed), request


ROLES = {"base": "10.0.0.1", "ocu": "10.0.0.5", "adm": "10.0.0.9", "guest": "10.0.0.66"}
RESOURCES = ("/thing", "/arm", "/arm/speed")
CARRIED_OUT_BY = {
    Category.PUBLISH: "registerPublisher",
    Category.SUBSCRIBE: "registerSubscriber",
    Category.OFFER: "registerService",
    Category.CALL: "lookupService",
    Category.READ: "getParam",
    Category.WRITE: "setParam",
}
WHO = st.lists(st.sampled_from([*ROLES, "*"]), max_size=2).map(" ".join)
NAMED = st.sampled_from(["default", "/**", "/arm/**", *RESOURCES])


def rules_of(keys: st.SearchStrategy[str]) -> st.SearchStrategy[dict[str, str] | None]:
    return st.none() | st.dictionaries(keys, WHO, max_size=4)


POLICIES = st.fixed_dictionaries(
    {section: rules_of(NAMED) for section in ("Publishers", "Subscribers", "Services", "Clients")}
    | {
        "Nodes": rules_of(st.sampled_from(["default", NAME])),
        "Commands": rules_of(st.sampled_from(["default", *sorted(COMMANDS)])),
        "Parameters": rules_of(st.tuples(st.sampled_from(["read", "write"]), NAMED).map(" ".join)),
        "Options": st.sampled_from([None, {"audit-only": "all"}, {"audit-only": "Commands"}]),
    }
)


def granted_by(decision: Decision) -> bool:
    return decision.allowed and not decision.would_deny


@settings(max_examples=examples(300), suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(POLICIES, st.sampled_from(list(ROLES.values())))
def test_an_action_has_the_answer_of_its_call(rules: dict[str, dict[str, str] | None], host: str) -> None:
    sections = {"Groups": ROLES, **{name: lines for name, lines in rules.items() if lines is not None}}
    text = "".join(
        f"[{name}]\n" + "".join(f"{key} = {who}\n" for key, who in lines.items())
        for name, lines in sections.items()
    )
    policy, known = compile_policy(text, file="policy"), PolicyContext()
    nobody = compile_policy("[Nodes]\n[Services]\n[Clients]\n[Parameters]\n", file="nobody")
    gate = CallGate(lambda: policy, Registry(), HostLimits())
    deeds_and_calls = [
        *((category, thing, MASTER_CALLS[call]) for category, call in CARRIED_OUT_BY.items() for thing in RESOURCES),
        *((Category.COMMAND, row.policy_name, row) for row in ROWS if row.row.category is Category.COMMAND
          and row.row.touches is None),
    ]  # fmt: skip
    for category, thing, row in deeds_and_calls:
        request = Request(ipaddress.ip_address(host), NAME, category, thing)
        arguments = [argument_of(parameter) for parameter in row.method.parameters]
        if row.resource is not None:
            arguments[row.resource] = thing
        caller = Caller(Peer(request.host, host, "10.0.0.1"), NAME, 0)
        answer = gate.decide(Attempt(caller, row, tuple(arguments)), {})
        assert isinstance(answer, Decision)
        found = explain(policy, request)
        assert found.allowed == answer.allowed, request
        explained = all(granted_by(one.decision) for one in (found, *found.also))
        assert explained == granted_by(answer), request
        assert case_passes(policy, request, granted_by(answer)), request
        assert bool(diff(policy, nobody, [request])) == answer.allowed, request
        try:
            lines = grant(text, "policy", known, DecidedRequest(request, rights_of(request))).added
        except UngrantableError:
            assert not granted_by(answer), request
        else:
            assert bool(lines) != granted_by(answer), request


@pytest.mark.anyio
@pytest.mark.parametrize("kind", list(Kind))
async def test_live_registrations_are_decided_as_their_calls(kind: Kind) -> None:
    world = ControlParts()
    call = MASTER_CALLS[GRANTS[kind]]
    resource = KEY_GIVEN if kind is Kind.PARAMETER else THING
    node = Incarnation(new_key(), NAME, HOST, parse_node_uri(URI), URI, "10.0.0.1", 1, 2)
    for number in range(1 << len(SECTIONS)):
        granted = frozenset(section for bit, section in enumerate(SECTIONS) if number >> bit & 1)
        world.current = compile_policy(text_of(granted, frozenset(), keyed=False), file="policy")
        verdict = gate_says(world.current, call, {}).allowed
        assert world.revocation.may_have(node, kind, resource) == verdict
        for live, name in (("topic", "requestTopic"), ("service", "lookupService")):
            given_by = MASTER_CALLS.get(name) or NODE_CALLS[name]
            may = may_keep(world.current, LiveRight(HOST, NAME, name, THING)).allowed
            assert may == gate_says(world.current, given_by, {}).allowed, live


def test_every_command_can_be_granted() -> None:
    named = {call.policy_name for call in ROWS if call.row.category is Category.COMMAND}
    assert named | {"lookupService"} == COMMANDS


def test_a_call_that_makes_a_node_binds_its_name() -> None:
    for call in ROWS:
        assert needs_node(deeds(call)[0]) == (call.row.node), call.name


def test_each_registering_call_has_an_unregistering_one() -> None:
    assert {call.kind: call.name for call in ROWS if call.verb is CallVerb.REGISTER} == GRANTS
    assert {call.name: call.kind for call in ROWS if call.verb is CallVerb.UNREGISTER} == GIVES_UP
    assert {GIVES_UP[name]: (GRANTS[GIVES_UP[name]], name) for name in GIVES_UP} == CALLS


def test_a_command_records_its_topic() -> None:
    row = RosCall("countPublishers", method(LookupCalls.lookup_node, TOPIC), CallVerb.READ)
    attempt = Attempt(Caller(Peer(HOST, str(HOST), "10.0.0.1"), NAME, 0), row, (THING,))
    assert (attempt.request.category, attempt.request.resource) == (Category.COMMAND, "countPublishers")
    assert attempt.about == {"topic": THING}


def test_a_service_that_cannot_be_looked_up_cannot_be_called() -> None:
    policy = compile_policy(
        "[Groups]\nocu = 10.0.0.5\nrobot1 = 10.0.0.9\n[Nodes]\ndefault = ocu\n[Clients]\ndefault = ocu\n"
        "[Commands]\ndefault = robot1\n",
        file="policy",
    )
    request = Request(HOST, "", Category.CALL, "/negate")
    assert not gate_says(policy, MASTER_CALLS["lookupService"], {}).allowed
    found = explain(policy, request)
    assert found.decision.allowed
    assert not found.allowed
    assert found.command is not None
    assert "lookupService" in found.command.decision.reason
    assert case_passes(policy, request, allowed=False)
    assert not case_passes(policy, request, allowed=True)
