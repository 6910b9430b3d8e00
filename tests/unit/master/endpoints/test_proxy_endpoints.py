import ipaddress

import pytest

from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import MasterSideApi, ProxyEndpoints
from appliance.policy.policy_compiler import compile_policy
from tests.support.incarnations import incarnation
from tests.support.memory_ports import face, memory_ports

POLICY = compile_policy("", file="a.ini")


@pytest.mark.anyio
async def test_ports_are_closed_once() -> None:
    """A node is closed when it is replaced, and again when it is forgotten: then another node may have its ports."""
    host = ipaddress.ip_address("10.0.0.5")
    dropped, ended = list[str](), list[str]()
    places = memory_ports(lambda: POLICY, drop=dropped.append)
    outer, relay = places.open(host)
    node = incarnation("/node", ports=(outer, relay))
    faces = ProxyEndpoints(
        Registry(), places, 9, lambda _sock, _handler: face(lambda: ended.append("closed"))
    )
    await faces.open(node, MasterSideApi(Registry()).handle)
    faces.close(node)
    places.unused.extendleft((relay, outer))
    assert places.open(host) == node.ports
    faces.close(node)
    assert (dropped, ended) == ([f"port:{outer}", f"port:{relay}"], ["closed"])
