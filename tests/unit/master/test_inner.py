"""The inner face: what ROSMaster tells a node is passed on, parameters to who may read them."""

import asyncio
import ipaddress
from functools import partial
from typing import Any

import pytest

from appliance.master.delivery import NodeCall
from appliance.master.http import HttpRequest, Peer
from appliance.master.inner import InnerFace
from appliance.master.parameters import may_be_told
from appliance.master.registry import Incarnation
from appliance.policy import compile_policy
from appliance.ros.uris import parse_node_uri
from appliance.ros.xmlrpc import Limits, Value, build_call, parse_response

RULES = "[Parameters]\nread /arm = 10.0.0.5\nread /arm/free = 10.0.0.5\nread default = 10.0.0.9\n"
MASTER = ipaddress.ip_address("127.0.0.1")


class Site:
    """An inner face for one node, what the node was told, and what was denied."""

    def __init__(self, host: str, rules: str = RULES, *, own: bool = False) -> None:
        uri = f"http://{host}:4000/"
        address, api = ipaddress.ip_address(host), parse_node_uri(uri)
        self.node = Incarnation("key", "/node", address, api, uri, "10.0.0.1", 19001, 19002, own=own)
        policy = compile_policy(rules, file="test.ini")
        self.policy = lambda: policy
        self.recorder = self
        self.told: list[tuple[str, Value]] = []
        self.denied: list[tuple[str, str]] = []
        told = partial(may_be_told, self)  # type: ignore[arg-type]  # stands for the master
        self.face = InnerFace(self, self, Limits(), may_be_told=told)  # type: ignore[arg-type]  # for registry and delivery

    def by_key(self, _key: str) -> Incarnation:
        """As `Registry`."""
        return self.node

    def push(self, _incarnation: Incarnation, call: NodeCall) -> None:
        """As `Delivery`."""
        self.told.append((str(call.parameters[0]), call.parameters[1]))

    def decided(self, caller: Any, method: str, _category: str, resource: str, _decision: Any) -> str:
        """As `Recorder`."""
        assert caller.caller_id == "/node"
        self.denied.append((method, resource))
        return "id"

    def update(self, key: str, value: Value) -> None:
        """ROSMaster tells the node of a parameter."""
        body = build_call("paramUpdate", ("/master", key, value))
        request = HttpRequest(Peer(MASTER, "127.0.0.1", "127.0.0.1"), "/key/", body, 0)
        answer = parse_response(asyncio.run(self.face.handle(request)))
        assert isinstance(answer, list)
        assert answer[0] == 1  # for ROSMaster there is nothing to see


@pytest.mark.parametrize(
    ("key", "value"), [("/arm/speed/", 4711), ("/arm/", {"speed": 4711}), ("/", {"arm": 4711})]
)
def test_what_came_to_be_below_a_key_is_told_to_who_may_read_it(key: str, value: Value) -> None:
    """A subscription to a value is none to what others put in its place: that is held back, and recorded."""
    site = Site("10.0.0.5")
    site.update(key, value)
    assert not site.told
    assert site.denied == [("paramUpdate", key.rstrip("/") or "/")]


def test_what_may_be_read_is_told() -> None:
    """Values that the policy grants, that they are gone, and everything where there is no section."""
    site = Site("10.0.0.5")
    site.update("/arm/", 7)
    site.update("/arm/", {})  # it was deleted
    site.update("/arm/free/", 1)
    assert site.told == [("/arm/", 7), ("/arm/", {}), ("/arm/free/", 1)]
    assert not site.denied
    for free in (Site("10.0.0.5", "[Nodes]\ndefault = *\n"), Site("10.0.0.5", own=True)):
        free.update("/arm/speed/", 4711)
        assert free.told == [("/arm/speed/", 4711)]
