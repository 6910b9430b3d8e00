import ipaddress

import pytest

from appliance.master.calls.call import CALLER_API, SERVICE_API, ApiUri, Attempt, Caller
from appliance.master.calls.call_table import MASTER_CALLS
from appliance.master.calls.gate import CallGate, HostLimits
from appliance.master.graph.registry import Kind, Registry
from appliance.master.graph.revocation import rosout_may_have
from appliance.policy.model import Decision
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.server import Peer
from roswire.uris import parse_node_uri

URI = "http://127.0.0.1:4000/"

ROSOUTS = [
    ("registerPublisher", "/rosout_agg"),
    ("unregisterPublisher", "/rosout_agg"),
    ("registerSubscriber", "/rosout"),
    ("unregisterSubscriber", "/rosout"),
    ("registerService", "/rosout/get_loggers"),
    ("unregisterService", "/rosout/set_logger_level"),
    ("hasParam", "/tcp_keepalive"),
    ("getParam", "/use_sim_time"),
]


def decide(caller_id: str, method: str, resource: str) -> Decision:
    policy, call = compile_policy("[Nodes]\n", file="p.ini"), MASTER_CALLS[method]
    peer = Peer(ipaddress.ip_address("127.0.0.1"), "127.0.0.1", "127.0.0.1")
    arguments = tuple(
        ApiUri(URI, parse_node_uri(URI)) if parameter in {CALLER_API, SERVICE_API} else resource
        for parameter in call.method.parameters
    )
    attempt = Attempt(Caller(peer, caller_id, 0, own=True), call, arguments)
    decision = CallGate(lambda: policy, Registry(), HostLimits()).decide(attempt, {})
    assert isinstance(decision, Decision)
    return decision


@pytest.mark.parametrize(("method", "resource"), ROSOUTS)
def test_rosout_may_start_and_end(method: str, resource: str) -> None:
    assert decide("/rosout", method, resource).allowed
    for other in ("/talker", "/rosrv", ""):
        decision = decide(other, method, resource)
        assert not decision.allowed
        assert "may not speak as" in decision.reason


@pytest.mark.parametrize("method", MASTER_CALLS)
def test_rosout_may_make_no_other_call(method: str) -> None:
    for resource in ("/cmd_vel", "/secret", "/", "/talker/set_logger_level"):
        decision = decide("/rosout", method, resource)
        assert not decision.allowed
        assert decision.reason.startswith("/rosout is the appliance's own node and may not ")
    granted = {name for name, _ in ROSOUTS}
    if method not in granted:
        for resource in ("/rosout", "/rosout_agg", "/use_sim_time"):
            assert not decide("/rosout", method, resource).allowed


def test_rosout_may_not_subscribe_to_its_own_topic() -> None:
    assert rosout_may_have(Kind.PUBLICATION, "/rosout_agg")
    assert not rosout_may_have(Kind.SUBSCRIPTION, "/rosout_agg")
    assert not rosout_may_have(Kind.PARAMETER, "/use_sim_time")
