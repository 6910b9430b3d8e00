import pytest

from appliance.master.calls.call import Caller
from appliance.master.calls.lookups import LookupCalls
from appliance.master.graph import registry
from appliance.master.graph.registry import Kind
from appliance.rpc.server import Peer
from tests.support.control_parts import HOST, ControlParts

pytestmark = pytest.mark.anyio


async def test_the_state_lists_all_live_registrations() -> None:
    world = ControlParts()
    talker, own = world.node("/talker", 1), world.node("/rosrv", 2)
    for node, kind, name in (
        (own, Kind.PUBLICATION, "/chatter"),
        (talker, Kind.PUBLICATION, "/chatter"),
        (own, Kind.PUBLICATION, "/alarms"),
        (talker, Kind.SUBSCRIPTION, "/b"),
        (own, Kind.SUBSCRIPTION, "/a"),
        (talker, Kind.SERVICE, "/serve"),
        (talker, Kind.PARAMETER, "/limit"),
    ):
        world.registry.register(node, kind, name, "4001")
    parts = world.registry, world.graph, world.relay, world.addresses
    calls = LookupCalls(*parts, port=11311, stop=pytest.fail, unseen="/rosrv")
    assert await calls.get_system_state(Caller(Peer(HOST, str(HOST), "10.0.0.1"), "/client", 0)) == [
        1,
        "current system state",
        [[["/chatter", ["/talker"]]], [["/b", ["/talker"]], ["/a", ["/rosrv"]]], [["/serve", ["/talker"]]]],
    ]


async def test_types_of_unused_topics_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_MAX_UNUSED_TYPES", 2)
    world = ControlParts()
    node, known = world.node("/a"), world.registry
    known.register(node, Kind.PUBLICATION, "/kept", "p/Kept")
    known.adopt_types([("/1", "p/One"), ("/kept", "p/Kept")])
    for topic in ("/2", "/3"):
        known.register(node, Kind.PUBLICATION, topic, "p/Type")
        known.unregister(node, Kind.PUBLICATION, topic)
    assert dict(known.types()) == {"/kept": "p/Kept", "/2": "p/Type", "/3": "p/Type"}
    known.forget_types()
    assert dict(known.types()) == {"/kept": "p/Kept"}
