"""Look-ups are answered from the registry: what is there is told, whatever ROSMaster is doing."""

import ipaddress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.master.caller import Caller
from appliance.master.calls.lookups import LookupCalls
from appliance.master.graph import registry
from appliance.master.graph.registry import Incarnation, Kind, Registry
from roswire.uris import parse_node_uri

HOST = ipaddress.ip_address("10.0.0.5")
CALLER = cast(Caller, SimpleNamespace(caller_id="/client", peer=SimpleNamespace(host=HOST)))

pytestmark = pytest.mark.anyio


class Site:
    """A registry, and the look-ups that it answers; ROSMaster is not there at all."""

    def __init__(self, unseen: str | None = None) -> None:
        self.registry = Registry()
        self.granted: list[Incarnation] = []
        parts: dict[str, Any] = {
            "registry": self.registry,
            "mediation": SimpleNamespace(carries_service=lambda _name: True, stand_ins=True),
            "graph": self,
            "enactor": SimpleNamespace(carry_out=lambda _effects: None),
            "relay": SimpleNamespace(port=lambda one, _kind, _name: one.relay_port),
            "addresses": SimpleNamespace(told_to=lambda _peer: "10.0.0.1"),
        }
        self.calls = LookupCalls(**parts, port=11311, stop=lambda _reason: None, unseen=unseen)

    def node(self, name: str, port: int) -> Incarnation:
        """A node that is known and has nothing yet."""
        uri = f"http://10.0.0.5:{port}/"
        one = Incarnation(f"{name}{port}", name, HOST, parse_node_uri(uri), uri, "10.0.0.1", port, port + 100)
        self.registry.add(one)
        return one

    def service_granted(self, incarnation: Incarnation, *_given: object) -> None:
        """As `Graph`."""
        self.granted.append(incarnation)

    async def types(self, subgraph: str = "") -> object:
        """What `getPublishedTopics` tells."""
        return (await self.calls.get_published_topics(CALLER, subgraph))[2]


async def test_a_service_is_the_last_providers() -> None:
    """The provider that the registry has when the answer is given is told and granted; nobody is no provider."""
    site = Site()
    assert await site.calls.lookup_service(CALLER, "/serve") == [-1, "no provider", ""]
    old, new = site.node("/server", 4000), site.node("/server", 4001)
    site.registry.register(old, Kind.SERVICE, "/serve", "5000")
    assert (await site.calls.lookup_service(CALLER, "/serve"))[2] == "rosrpc://10.0.0.1:4100"
    site.registry.replace(old, 0.0)
    site.registry.register(new, Kind.SERVICE, "/serve", "5001")
    told = "rosrpc://10.0.0.1:4101"
    assert await site.calls.lookup_service(CALLER, "/serve") == [1, f"rosrpc URI: [{told}]", told]
    assert site.granted == [old, new]


async def test_a_node_is_known_while_it_has_something() -> None:
    """As on a plain master: a node is what registered, at the port that stands for it."""
    site = Site()
    one = site.node("/talker", 4000)
    assert await site.calls.lookup_node(CALLER, "/talker") == [-1, "unknown node [/talker]", ""]
    site.registry.register(one, Kind.PUBLICATION, "/chatter", "std_msgs/String")
    assert await site.calls.lookup_node(CALLER, "/talker") == [1, "node api", "http://10.0.0.1:4000/"]
    site.registry.overshadow(one, 0.0)
    assert (await site.calls.lookup_node(CALLER, "/talker"))[0] == -1


async def test_the_state_has_what_counts() -> None:
    """Publishers, subscribers and services, in the order of registration; a publisher that is not shown is left out."""
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


async def test_a_type_is_taken_as_rosmaster_does() -> None:
    """The last publisher's; a subscriber's and `*` count only where there is none yet."""
    site = Site()
    one, two, three = (site.node(name, port) for name, port in (("/a", 4000), ("/b", 4001), ("/c", 4002)))
    site.registry.register(one, Kind.SUBSCRIPTION, "/x", "p/First")
    site.registry.register(two, Kind.PUBLICATION, "/x", "*")
    assert await site.types() == [["/x", "p/First"]]
    site.registry.register(three, Kind.PUBLICATION, "/x", "p/Last")
    site.registry.register(one, Kind.SUBSCRIPTION, "/x", "p/Other")
    assert await site.types() == [["/x", "p/Last"]]
    site.registry.unregister(three, Kind.PUBLICATION, "/x")
    assert await site.types() == [["/x", "p/Last"]]
    for node, kind in ((one, Kind.SUBSCRIPTION), (two, Kind.PUBLICATION)):
        site.registry.unregister(node, kind, "/x")
    site.registry.register(one, Kind.PUBLICATION, "/x", "*")
    assert await site.types() == [["/x", "p/Last"]], "it is remembered when nobody has it"
    site.registry.register(one, Kind.SUBSCRIPTION, "/never", "*")
    site.registry.register(two, Kind.PUBLICATION, "/any", "*")
    every = [["/x", "p/Last"], ["/any", "*"]]
    assert (await site.calls.get_topic_types(CALLER))[2] == every


def test_types_of_topics_that_nobody_has_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest goes; what ROSMaster remembers is adopted, and a new ROSMaster remembers nothing."""
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


async def test_only_what_is_below() -> None:
    """A subgraph ends at a `/`: `/arm` is no part of `/ar`."""
    site = Site()
    one = site.node("/a", 4000)
    for topic in ("/arm/x", "/ar/y", "/ar"):
        site.registry.register(one, Kind.PUBLICATION, topic, "p/T")
    assert await site.types("/ar") == [["/ar/y", "p/T"]]
    assert await site.types("/") == [["/arm/x", "p/T"], ["/ar/y", "p/T"], ["/ar", "p/T"]]
