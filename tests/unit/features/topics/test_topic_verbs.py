import ipaddress
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from appliance.channel.answers.graph_answers import Flow, Topic
from appliance.control.errors import UnavailableError, UnknownThingError
from appliance.control.operators.queries import graph_of, topic_of
from appliance.features.topics.control_part import TopicLooks
from appliance.features.topics.requests import TopicLook
from appliance.features.topics.verbs import part_of
from appliance.master.graph.registry import Incarnation, Kind, Registry
from roswire.definitions import Definitions
from roswire.message_view import CUT, read_fields
from roswire.uris import parse_node_uri
from tests.support.answers import example
from tests.support.core import FakeTrail

HOST = ipaddress.ip_address("10.0.0.1")
DEFINITIONS = Definitions.from_files(
    {"a/Scan.msg": "float32[] ranges\nuint8[] data\nPose pose\nuint8 last\n", "a/Pose.msg": "float32 x\n"}
)


def scan(length: int) -> dict[str, object]:
    whole = (720).to_bytes(4, "little") + b"\0" * 2880 + (921_600).to_bytes(4, "little") + b"\1" * 921_600
    fields = read_fields(DEFINITIONS, "a/Scan", (whole + b"\0" * 4 + b"\7")[:length])
    assert fields is not None
    return fields


def test_omitted_parts_are_marked() -> None:
    whole, cut = scan(1_000_000), scan(3000)
    assert part_of(whole, "ranges.3") == 0
    assert part_of(whole, "ranges.300") == f"{CUT} 704 more"
    assert part_of(whole, "data").endswith(f"{CUT} 921568 more")
    assert part_of(whole, "data.5000") == f"{CUT} 921568 more"
    assert part_of(whole, "last") == 7
    assert part_of(cut, "pose.x") == part_of(cut, "last") == CUT


@pytest.mark.parametrize("path", ["nothing", "ranges.x", "pose.y", "last.x", "data.x"])
def test_a_missing_field_is_an_error(path: str) -> None:
    with pytest.raises(typer.Exit):
        part_of(scan(1_000_000), path)


class Robot:
    """A robot with the topic /odom, and the number of looks that its relay got."""

    looks = 0

    def topic(self, name: str) -> Topic:
        return example(Topic, name=name, type="nav_msgs/Odometry", mediated=True)

    async def look(self, *_asked: object, **_named: object) -> list[object]:
        self.looks += 1
        return []


def test_one_topic_is_read_as_in_the_graph() -> None:
    registry, carried = Registry(), SimpleNamespace(connections={}, flow=lambda *_of: example(Flow))
    relay: Any = SimpleNamespace(carried=carried, carries_topic=lambda _name: True)
    for number, kind in enumerate((Kind.PUBLICATION, Kind.SUBSCRIPTION, Kind.SUBSCRIPTION, Kind.PUBLICATION)):
        api = f"http://h:{number + 1}/"
        node = Incarnation(
            f"k{number}", f"/n{number}", HOST, parse_node_uri(api), api, "h", 1, 2, own=number == 3
        )
        registry.add(node)
        registry.register(node, kind, "/odom" if number < 3 else "/own", "nav_msgs/Odometry")
    assert [topic_of(registry, relay, "/odom")] == graph_of(registry, relay).topics
    for name, hint in (("/odo", "did you mean /odom"), ("/own", "rosrv topic list")):
        with pytest.raises(UnknownThingError, match=hint):
            topic_of(registry, relay, name)


@pytest.mark.anyio
async def test_no_message_is_shown_before_the_record_of_the_look_is_on_disk() -> None:
    robot: Any = Robot()
    waits: list[int] = []
    trail = FakeTrail(on_disk=lambda: waits.append(robot.looks))
    looks = TopicLooks(robot, robot, trail)
    for asked in range(2):  # the record covers the second one too
        await looks.messages(TopicLook("/odom"), "ann")
        assert (waits, robot.looks) == ([*range(asked + 1)], asked + 1)
    for who in ("ann", "eve"):
        trail.log.failure = "the disk is full"
        with pytest.raises(UnavailableError, match="cannot be recorded: the disk is full"):
            await looks.messages(TopicLook("/odom"), who)
    assert (robot.looks, trail.events) == (2, ["topic looked into"] * 2)
