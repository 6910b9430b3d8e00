"""The inner face: what ROSMaster tells a node is passed on to that node, and ROSMaster learns nothing of it."""

import asyncio
import ipaddress
from typing import Any

import pytest

from appliance.master.delivery import NodeCall
from appliance.master.http import HttpRequest, Peer
from appliance.master.inner import InnerFace
from appliance.ros.xmlrpc import FaultReceived, Limits, Value, build_call, parse_response

MASTER = ipaddress.ip_address("127.0.0.1")


class Site:
    """An inner face for one node, and what was passed on."""

    def __init__(self) -> None:
        self.told: list[tuple[Any, ...]] = []
        nodes: Any = self  # for registry and delivery
        self.face = InnerFace(nodes, nodes, Limits(), tell_parameter=self._tell)

    def by_key(self, key: str) -> Any:
        """As `Registry`."""
        return "node" if key == "key" else None

    def push(self, node: Any, call: NodeCall) -> None:
        """As `Delivery`."""
        self.told.append((node, call.method, *call.parameters))

    def _tell(self, node: Any, key: str, value: Value, size: int) -> None:
        self.told.append((node, "paramUpdate", key, value))
        assert size > len(str(value))

    def call(self, path: str, method: str, *params: Value) -> Any:
        """A call of ROSMaster."""
        request = HttpRequest(Peer(MASTER, "127.0.0.1", "127.0.0.1"), path, build_call(method, params), 0)
        return parse_response(asyncio.run(self.face.handle(request)))


def test_parameters_and_shutdowns_are_passed_on() -> None:
    """Each to the node that the path stands for; lists of publishers are made elsewhere."""
    site = Site()
    assert site.call("/key/", "paramUpdate", "/master", "/arm/", {"max": 5}) == [1, "", 0]
    assert site.call("/key/", "shutdown", "/master", "another has the name") == [1, "", 0]
    assert site.call("/key/", "publisherUpdate", "/master", "/topic", ["http://a:1/"]) == [1, "", 0]
    assert site.told == [
        ("node", "paramUpdate", "/arm/", {"max": 5}),
        ("node", "shutdown", "another has the name"),
    ]


def test_nobody_and_nonsense() -> None:
    """A path that stands for nobody is a fault; a call that no master makes is refused."""
    site = Site()
    with pytest.raises(FaultReceived, match="nobody is here"):
        site.call("/other/", "shutdown", "/master", "reason")
    assert site.call("/key/", "requestTopic", "/master", "/topic", [])[0] == 0
    assert not site.told
