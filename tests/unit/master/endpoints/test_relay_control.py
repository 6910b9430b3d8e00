"""Each relay receives its topics with its own port of each node. A topic keeps its grants in another relay."""

import asyncio
import ipaddress
from collections.abc import Awaitable, Callable
from dataclasses import replace

import msgspec
import pytest

from appliance.audit.log.record import RuleReference
from appliance.channel import messages
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.topic_taps_control import TapRequests
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Kind, Registry
from appliance.policy.model import Address, Category
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.quotas.pool import Bounds
from appliance.quotas.table import GRANTS
from appliance.specifications.allocation import SERVICE, TOPIC, Allocation, AllocationPlan, Move
from tests.support.control_parts import NoSpecifications, no_own_call
from tests.support.core import FakeTrail
from tests.support.incarnations import incarnation
from tests.support.memory_channel import HeldChannel
from tests.support.scripted_nodes import ScriptedNodes

pytestmark = pytest.mark.anyio
HOST = ipaddress.ip_address("10.0.0.5")


def policy(*limits: str, nodes: str = "default = 10.0.0.5") -> Policy:
    return compile_policy("\n".join(["[Limits]", *limits, "[Nodes]", nodes]), file="p.ini")


class World:
    def __init__(self, grants: Bounds = GRANTS.bounds) -> None:
        self.trail = FakeTrail()
        self.specifications = NoSpecifications()
        self.cut_off: list[tuple[str, str]] = []
        self.registry = Registry()
        self.allocation = Allocation(2)
        self.policy = policy()
        self.put(left=0, right=1)
        self.relay = self._relay_control(grants)
        self.graph = RosGraph(self.registry, self.grants, self.trail)
        self.node = incarnation("/node", key="key", ports=(1, 2, 3))
        self.registry.add(self.node)
        self.links = [HeldChannel(), HeldChannel()]
        for index, link in enumerate(self.links):
            self.relay.attach(index, link)
        for kind, name, detail in (
            (Kind.PUBLICATION, "/left", "std_msgs/String"),
            (Kind.PUBLICATION, "/right", "std_msgs/String"),
            (Kind.SERVICE, "/serve", "4001"),
        ):
            self.registry.register(self.node, kind, name, detail)
        self.flush()

    def _relay_control(self, grants: Bounds) -> RelayControl:
        carried = RelayTraffic(
            self.trail,
            self.registry,
            2,
            lambda node, topic: self.cut_off.append((node.name, topic)),
        )
        self.grants = Grants(self.registry.mark, carried.used_permissions, grants)
        return RelayControl(
            self.registry,
            self.grants,
            lambda port: port,
            ScriptedNodes(self.registry),
            carried,
            allocation=self.allocation,
            policy=lambda: self.policy,
            monitors=lambda: self.specifications,
            broken=lambda _incarnation: None,
            own_topics={},
            own_call=no_own_call,
        )

    def grant_topic(self, topic: str, host: Address, caller_id: str) -> None:
        self.graph.topic_granted(self.node, topic, host, caller_id)
        self.flush()

    def flush(self) -> None:
        self.relay.flush(self.registry.take_changes())

    def use(self, now: Policy) -> None:
        self.policy = now
        self.relay.compare()

    def withdraw(self, kind: Kind, resource: str) -> None:
        self.registry.unregister(self.node, kind, resource)
        self.flush()

    def put(self, **topics: int) -> None:
        resources = {(TOPIC, f"/{name}"): relay for name, relay in topics.items()}
        self.allocation.adopt(AllocationPlan({}, {**resources, (SERVICE, "/serve"): 0}))


@pytest.fixture
async def world() -> World:
    return World()


async def test_an_order_is_done_when_every_relay_confirms_it(world: World) -> None:
    relay, (first, second) = world.relay, world.links

    async def waiting() -> asyncio.Task[None]:
        task = asyncio.ensure_future(relay.carried_out())
        await asyncio.sleep(0)
        return task

    one, other = await waiting(), await waiting()
    assert [link.heard()[-1] for link in world.links] == [messages.OrdersAsked()] * 2
    first.say(messages.OrdersCarriedOut())
    second.say(messages.OrdersCarriedOut())
    await one
    assert not other.done()
    relay.attach(0, HeldChannel())
    second.end()
    await other
    relay.attach(0, again := HeldChannel())
    again.end()
    await relay.carried_out()


async def test_a_relay_that_hangs_delays_only_what_it_carries(world: World) -> None:
    relay, (first, second) = world.relay, world.links
    world.put(a=0, b=1)
    every, other = (asyncio.ensure_future(relay.carried_out(topics)) for topics in (None, ["/b"]))
    asked = asyncio.ensure_future(relay.taps.stoppers("/a"))
    await asyncio.sleep(0)
    for _ in range(2):
        second.say(messages.OrdersCarriedOut())
    await other
    assert first.heard()[-1] == messages.StopWanted(1, "/a", begin=False)
    assert await asked is None, "not that there is no guard"
    assert not every.done()
    first.end()  # the supervisor replaced it
    await every


async def test_each_relay_receives_its_topics(world: World) -> None:
    relay, node, (first, second) = world.relay, world.node, world.links
    placed = messages.NodePlaced("key", "/node", "10.0.0.5")
    assert (placed, (2,)) in first.sent
    assert (placed, (3,)) in second.sent
    assert messages.ServicePlaced("key", "/serve", "10.0.0.5", 4001) in first.heard()
    assert messages.PublicationPlaced("key", "/right", "std_msgs/String") == second.heard()[-1]
    assert [relay.port(node, Kind.PUBLICATION, name) for name in ("/left", "/right")] == [2, 3]
    assert relay.port(node, Kind.SERVICE, "/serve") == 2
    world.grant_topic("/right", HOST, "/ear")
    grant = messages.GrantInstalled("key", "/right", "10.0.0.5", "/ear")
    assert (first.heard(), second.heard()) == ([], [grant])
    again = HeldChannel()
    relay.attach(1, again)
    assert again.heard() == [
        world.specifications.statement(1), messages.StateBegan(2), placed,
        messages.PublicationPlaced("key", "/right", "std_msgs/String"), grant,
        messages.StateEnded(2),
    ]  # fmt: skip
    world.withdraw(Kind.PUBLICATION, "/left")
    assert (first.heard(), again.heard()) == ([messages.FactWithdrawn(("publication", "key", "/left"))], [])
    world.registry.overshadow(node, 0.0)
    world.flush()
    assert first.heard() == again.heard() == [messages.FactWithdrawn(("node", "key"))]


async def test_relays_know_which_hosts_the_policy_names(world: World) -> None:
    (first, second) = world.links
    world.grant_topic("/right", HOST, "/ear")
    world.graph.service_granted(world.node, "/serve", HOST, "/client")
    world.flush()
    for link in world.links:
        link.heard()
    world.use(policy(nodes="default = *"))
    assert first.heard() == [
        messages.PublicationPlaced("key", "/left", "std_msgs/String", named=False),
        messages.ClientGranted("key", "/serve", "10.0.0.5", "/client", named=False),
    ]
    assert second.heard() == [
        messages.PublicationPlaced("key", "/right", "std_msgs/String", named=False),
        messages.GrantInstalled("key", "/right", "10.0.0.5", "/ear", named=False),
    ]
    world.use(policy(nodes="default = *"))
    assert first.heard() == second.heard() == []


async def test_a_topic_moves_with_its_grants(world: World) -> None:
    relay, (first, second) = world.relay, world.links
    world.grant_topic("/right", HOST, "/ear")
    world.grant_topic("/left", HOST, "/ear")
    for link in world.links:
        link.heard()
    moves = [Move(TOPIC, "/right", 1, 0)]
    relay.withdraw_moving(moves)
    world.put(left=0, right=0)
    relay.place_moved(moves)
    assert second.heard() == [
        messages.FactWithdrawn(("publication", "key", "/right")),
        messages.FactWithdrawn(("grant", "key", "/right", "10.0.0.5", "/ear")),
    ]
    assert first.heard() == [
        messages.PublicationPlaced("key", "/right", "std_msgs/String"),
        messages.GrantInstalled("key", "/right", "10.0.0.5", "/ear"),
    ]
    assert relay.port(world.node, Kind.PUBLICATION, "/right") == 2


async def test_a_grant_that_is_revoked_after_a_move_is_invalid_everywhere(world: World) -> None:
    relay, (first, second) = world.relay, world.links
    world.graph.service_granted(world.node, "/serve", HOST, "/c")
    world.flush()
    first.heard()
    away, back = [Move(SERVICE, "/serve", 0, 1)], [Move(SERVICE, "/serve", 1, 0)]
    relay.withdraw_moving(away)
    assert messages.FactWithdrawn(("client", "key", "/serve", "10.0.0.5", "/c")) in first.heard()
    world.allocation.adopt(AllocationPlan({}, {(SERVICE, "/serve"): 1}))
    relay.place_moved(away)
    world.grants.take(world.grants.all()[0])
    world.flush()
    assert second.heard()[-1] == messages.FactWithdrawn(("client", "key", "/serve", "10.0.0.5", "/c"))
    relay.withdraw_moving(back)
    world.put()
    relay.place_moved(back)
    assert first.heard() == [messages.ServicePlaced("key", "/serve", "10.0.0.5", 4001)]


@pytest.mark.parametrize(
    ("ended", "cut_off"), [(None, [("/ear", "/left")]), (Kind.PUBLICATION, []), (Kind.SUBSCRIPTION, [])]
)
async def test_a_subscriber_that_lost_its_connection(
    world: World, ended: Kind | None, cut_off: list[tuple[str, str]]
) -> None:
    ear = incarnation("/ear", 4001, ports=(4, 5, 6))
    world.registry.add(ear)
    world.registry.register(ear, Kind.SUBSCRIPTION, "/left", "std_msgs/String")
    link = world.links[0]
    link.say(messages.ConnectionOpened(7, "key", "/left", "topic", "10.0.0.5", "/ear"))
    if ended is not None:
        leaving = {Kind.PUBLICATION: world.node, Kind.SUBSCRIPTION: ear}[ended]
        world.registry.unregister(leaving, ended, "/left")
    link.say(messages.ConnectionClosed(7, "broken"))
    assert world.cut_off == cut_off


async def test_a_lost_relay_loses_its_connections(world: World) -> None:
    relay, (first, second) = world.relay, world.links
    for link, topic in ((first, "/left"), (second, "/right")):
        link.say(messages.ConnectionOpened(7, "key", topic, "topic", "10.0.0.5", "/ear"))
    assert len({connection.number for connection in relay.carried.connections.values()}) == 2
    second.end()
    assert [connection.resource for connection in relay.carried.connections.values()] == ["/left"]
    assert (world.specifications.lost, relay.presence) == ([1], "1 of 2 are away")
    first.end()
    assert relay.presence == "away"


async def test_a_publisher_that_is_cut_for_its_messages_is_recorded(world: World) -> None:
    say = world.links[0].say
    say(messages.UpstreamLost("key", "/left", "the publisher closed the connection"))
    assert world.trail.records == []
    say(messages.UpstreamLost("key", "/left", "a message of 1 GiB is declared", "limit exceeded"))
    [record] = world.trail.records
    assert (record.event, record.reason) == ("limit exceeded", "a message of 1 GiB is declared")
    assert (record.host, record.caller_id, record.resource) == ("10.0.0.5", "/node", "/left")
    assert record.decision == "deny"
    say(messages.UpstreamLost("other", "/left", "of nobody that is known", "malformed"))
    assert len(world.trail.records) == 1


async def test_unreported_events_of_a_relay_are_recorded(world: World) -> None:
    row = messages.TopicTraffic("key", "/left", 400, 4000, 0, 1)
    world.links[0].say(messages.TrafficReported([row], 40.0, 7))
    assert world.relay.carried.traffic["key", "/left"].messages_per_second == 10
    [record] = world.trail.records
    assert (record.event, record.detail["lost"]) == ("records lost", 7)
    assert "7 connections" in record.reason


async def test_limits_of_the_policy_are_sent_and_sent_again_on_change(world: World) -> None:
    relay, (first, second) = world.relay, world.links
    world.grant_topic("/right", HOST, "/ear")
    world.grant_topic("/left", HOST, "/ear")
    first.heard()
    second.heard()
    line = "/right = publisher 10.0.0.5 30 Hz, topic 1 MB/s, subscriber 5 Hz"
    world.use(policy(line))
    placed = messages.PublicationPlaced(
        "key",
        "/right",
        "std_msgs/String",
        messages.FlowLimit(30),
        messages.FlowLimit(bytes=1e6),
        world.policy.counted_as(HOST),
    )
    grant = messages.GrantInstalled("key", "/right", "10.0.0.5", "/ear", messages.FlowLimit(5))
    assert (first.heard(), second.heard()) == ([], [placed, grant])
    world.use(policy(line))
    assert second.heard() == []
    relay.attach(1, second)
    told = second.heard()
    assert placed in told
    assert grant in told
    world.use(policy())
    assert second.heard() == [
        messages.PublicationPlaced("key", "/right", "std_msgs/String"),
        messages.GrantInstalled("key", "/right", "10.0.0.5", "/ear"),
    ]


async def test_drops_of_a_limit_are_recorded_with_its_line(world: World) -> None:
    world.policy = policy("/left = publisher 30 Hz, subscriber 5 Hz")
    rows = [
        messages.LimitedRow("key", "/left", "publisher", "10.0.0.5", "/node", 7, 70),
        messages.LimitedRow("key", "/left", "subscriber", "10.0.0.6", "/ear", 3, 30),
    ]
    world.links[0].say(messages.MessagesLimited(rows))
    one, other = world.trail.rows[-2:]
    assert (one["event"], one["severity"], other["severity"]) == ("rate limited", "warning", "info")
    assert (one["rule"], one["count"], one["bytes"]) == (RuleReference("Limits", "/left", "p.ini", 2), 7, 70)
    assert (other["host"], other["caller_id"], other["publisher"]) == ("10.0.0.6", "/ear", "/node")
    assert world.relay.carried.limited_messages == {("/left", "publisher"): 7, ("/left", "subscriber"): 3}


async def test_grants_of_all_hosts_are_bounded() -> None:
    world = World(Bounds(whole=100, host=60, unknown=0, kept=0))
    robot = ipaddress.ip_address("10.0.0.9")
    world.grant_topic("/left", robot, "/ear")
    for number in range(200):
        world.grant_topic("/left", ipaddress.ip_address("10.1.0.1"), f"/ear{number}")
        for guest in range(2, 5):
            address = ipaddress.ip_address(f"10.1.0.{guest}")
            world.grant_topic("/left", address, f"/ear{number}")
        assert len(world.grants.all()) <= 100
    assert "10.0.0.9" in {row.host for row in world.grants.all()}


@pytest.mark.parametrize(
    ("lines", "wanted"),
    [
        ("", False),
        ("[Authority]\nbase = /left\ntake base = 10.0.0.5\n", True),
        ("[Authority]\nbase = /left\nask base = 10.0.0.5\n", True),
        ("[Authority]\nbase = /left\nrank base = 10.0.0.5/node > 10.0.0.6\n", True),
        ("[Publishers]\n/left = ask 10.0.0.5\n", False),
        ("[Publishers]\n/left = ask 10.0.0.5\n# approved\n", True),
    ],
)
async def test_a_relay_keeps_each_publication_whose_silence_ends_a_right(
    world: World, lines: str, wanted: bool
) -> None:
    """Every topic of a group, with any holder or none, and each approved one; not all that could be approved."""
    asked = frozenset({(HOST, Category.PUBLISH, "/left")} if "# approved" in lines else ())
    world.use(replace(compile_policy(lines, file="p.ini"), approved=asked))
    placed = [one for one in world.links[0].heard() if isinstance(one, messages.PublicationPlaced)]
    assert placed[-1].wanted == wanted


ANSWERS: dict[str, tuple[Callable[[TapRequests], Awaitable[object]], Callable[[int], messages.Message]]] = {
    "look": (
        lambda taps: taps.look("/left", 1, 60, "eve", latched=False),
        lambda number: messages.MessageSeen(number, "key", 0, "", 1, {}),
    ),
    "stop": (lambda taps: taps.stop("/left"), lambda number: messages.StopBegun(number, ["safe"])),
    "stoppers": (lambda taps: taps.stoppers("/left"), lambda number: messages.StopBegun(number, ["safe"])),
    "test": (
        lambda taps: taps.test(messages.GuardTestWanted(0, "deadman", "/left", [], 0)),
        lambda number: messages.GuardTested(number, act="stopped"),
    ),
}


@pytest.mark.parametrize("asked", ANSWERS)
async def test_only_the_relay_that_was_asked_answers(world: World, asked: str) -> None:
    ask, answer = ANSWERS[asked]
    found = asyncio.ensure_future(ask(world.relay.taps))
    await asyncio.sleep(0)
    said = answer(msgspec.to_builtins(world.links[0].heard()[-1])["number"])
    world.put(left=1)  # it moves after the question
    for link in (world.links[1], world.links[1]):
        link.say(said)
        await asyncio.sleep(0)
    assert not found.done()
    world.links[0].say(said)
    assert await found


async def test_only_the_relay_that_carries_a_topic_reports_its_driver(world: World) -> None:
    moving, lost = (messages.RankReported("/left", "key", 0, standing) for standing in ("moving", "lost"))
    before = world.relay.ranks.of("/left")
    world.links[1].say(moving)
    assert world.relay.ranks.of("/left") == before
    world.links[0].say(moving)
    assert world.relay.ranks.of("/left") == moving
    world.put(left=1)
    world.links[0].say(lost)  # too late: the next relay began with the earlier one
    assert world.relay.ranks.of("/left") == moving
    world.links[1].say(lost)
    assert world.relay.ranks.of("/left") == lost
