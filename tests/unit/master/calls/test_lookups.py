import ipaddress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.master.calls.call import Caller
from appliance.master.calls.lookups import LookupCalls
from appliance.master.graph import registry
from appliance.master.graph.registry import Incarnation, Kind, Registry
from roswire.uris import parse_node_uri

HOST = ipaddress.ip_address("10.0.0.5")
CALLER = cast(Caller, SimpleNamespace(caller_id="/client", peer=SimpleNamespace(host=HOST)))

pytestmark = pytest.mark.anyio


class Site:
    def __init__(self, unseen: str | None = None) -> None:
        self.registry = Registry()
        self.granted: list[Incarnation] = []
        parts: dict[str, Any] = {
            "registry": self.registry,
            "graph": self,
            "relay": SimpleNamespace(
                port=lambda one, _kind, _name: one.relay_port,
                carries_service=lambda _name: True,
                stand_ins=True,
            ),
            "addresses": SimpleNamespace(address_for=lambda _peer: "10.0.0.1"),
        }
        self.calls = LookupCalls(**parts, port=11311, stop=lambda _reason: None, unseen=unseen)

    def node(self, name: str, port: int) -> Incarnation:
        uri = f"http://10.0.0.5:{port}/"
        one = Incarnation(f"{name}{port}", name, HOST, parse_node_uri(uri), uri, "10.0.0.1", port, port + 100)
        self.registry.add(one)
        return one

    def service_granted(self, incarnation: Incarnation, *_given: object) -> None:
        self.granted.append(incarnation)

    async def types(self, subgraph: str = "") -> object:
        return (await self.calls.get_published_topics(CALLER, subgraph))[2]


async def test_the_state_lists_all_live_registrations() -> None:
    site = Site(unseen="/rosrv")
    talker, own = site.node("/talker", 4000), site.node("/rosrv", 4001)
    for node, kind, name in (
        (own, Kind.PUBLICATION, "/chatter"),
        (talker, Kind.PUBLICATION, "/chatter"),
        (own, Kind.PUBLICATION, "/alarms"),
        (talker, Kind.SUBSCRIPTION, "/b"),
        (own, Kind.SUBSCRIPTION, "/a"),
        (talker, Kind.SERVICE, "/serve"),
        (talker, Kind.PARAMETER, "/limit"),
    ):
        site.registry.register(node, kind, name, "std_msgs/String")
    assert await site.calls.get_system_state(CALLER) == [
        1,
        "current system state",
        [[["/chatter", ["/talker"]]], [["/b", ["/talker"]], ["/a", ["/rosrv"]]], [["/serve", ["/talker"]]]],
    ]


def test_types_of_unused_topics_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_MOST_UNUSED_TYPES", 2)
    site = Site()
    node = site.node("/a", 4000)
    site.registry.register(node, Kind.PUBLICATION, "/kept", "p/Kept")
    site.registry.adopt_types([("/1", "p/One"), ("/kept", "p/Kept")])
    for topic in ("/2", "/3"):
        site.registry.register(node, Kind.PUBLICATION, topic, "p/Type")
        site.registry.unregister(node, Kind.PUBLICATION, topic)
    assert dict(site.registry.types()) == {"/kept": "p/Kept", "/2": "p/Type", "/3": "p/Type"}
    site.registry.forget_types()
    assert dict(site.registry.types()) == {"/kept": "p/Kept"}
