import asyncio
import ipaddress
from collections.abc import Callable
from random import Random
from typing import Any

import pytest

from appliance.master.endpoints.delivery import LONG_ANSWER, Delivery, NodeCall
from appliance.master.graph.registry import Incarnation
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import NODE_CALLS_UNDER_WAY
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import FaultReceived, Value
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
LONG = [f"http://10.0.0.1:{19001 + number}/" for number in range(500)]


class Post:
    """The calls to nodes whose answers wait for `answers`; `lists` has what arrived."""

    def __init__(self, **bounds: Any) -> None:
        self.answers = asyncio.Event()
        self.failure: CallFailedError | None = None
        self.lost, self.lists = list[tuple[str, Value]](), list[tuple[str, Any]]()
        self.receives: Callable[[str, Any], None] = lambda _topic, _publishers: None
        self.world = ControlParts()
        self.world.nodes.answer = self.answer
        self.delivery = Delivery(
            self.world.nodes,
            troubled=self._troubled,
            quota_class=lambda _host: QuotaClass.REGISTERED,
            **bounds,
        )
        self.incarnation = self.world.node("/n")

    async def answer(self, _node: Incarnation, _method: str, parameters: tuple[Value, ...]) -> Value:
        topic, publishers = str(parameters[1]), parameters[2]
        self.receives(topic, publishers)
        await self.answers.wait()
        if self.failure is not None:
            raise self.failure
        self.lists.append((topic, publishers))
        return [1, "", 0]

    @property
    def heard(self) -> list[str]:
        return [topic for topic, _publishers in self.lists]

    def _troubled(self, incarnation: Incarnation, call: NodeCall, _why: str) -> None:
        self.lost.append((incarnation.name, call.parameters[0]))

    def node_on(self, host: str, name: str) -> Incarnation:
        node = self.world.node(name)
        node.host = ipaddress.ip_address(host)
        return node

    def push(self, *topics: str, publishers: list[str]) -> None:
        for topic in topics:
            self.delivery.push_list(self.incarnation, topic, tuple(publishers))


async def test_nothing_waits_for_a_node_that_cannot_be_called() -> None:
    post = Post()
    post.incarnation.reached = False
    post.push("/t", publishers=LONG)
    post.delivery.push(post.incarnation, NodeCall("paramUpdate", ("/a/", 1)))
    post.delivery.push_unasked(post.incarnation, "/a", NodeCall("paramUpdate", ("/a/", 1)))
    post.answers.set()
    await post.world.settle()
    assert (post.delivery.waiting, post.heard) == (0, [])


async def test_lists_of_publishers_are_bounded_in_bytes() -> None:
    post = Post(queued=Bounds(100_000, 100_000, 0, 0))
    post.push(*(f"/t{number}" for number in range(50)), publishers=LONG)
    assert post.delivery.waiting < 8
    assert len(post.lost) == 50 - post.delivery.waiting
    post.answers.set()
    await post.world.settle()
    assert len(post.heard) < 8
    assert post.heard[-1] == "/t49"
    assert post.delivery.weight == 0


async def test_a_dropped_queue_frees_its_bytes() -> None:
    post = Post()
    post.push("/a", "/b", publishers=LONG)
    assert post.delivery.weight > 20_000
    post.delivery.drop(post.incarnation)
    assert (post.delivery.weight, post.delivery.waiting) == (0, 0)
    post.answers.set()
    await post.world.settle()


async def test_a_call_that_stays_undelivered_is_reported() -> None:
    post = Post(tries=2)
    post.failure = CallFailedError("it does not answer")
    post.answers.set()
    post.push("/a", publishers=[])
    await post.world.settle()
    assert post.lost == [("/n", "/a")]


async def test_a_call_that_a_node_answers_with_a_fault_has_arrived() -> None:
    post = Post(tries=2)
    post.failure = CallFailedError("it answers with a fault")
    post.failure.__cause__ = FaultReceived(1, "not for me")
    post.answers.set()
    post.push("/a", publishers=[])
    await post.world.settle()
    assert post.lost == []


async def test_a_publisher_is_added_some_time_after_its_removal() -> None:
    post = Post()
    post.answers.set()
    began = asyncio.get_running_loop().time()
    for publishers in ([], ["a"], ["a", "b"], ["a"], ["a", "b", "c"]):
        post.push("/t", publishers=publishers)
    post.push("/other", publishers=["a"])
    await asyncio.sleep(0.25)
    assert post.lists == [("/t", []), ("/other", ["a"])]
    post.push("/late", publishers=["a"])
    await asyncio.sleep(0.01)
    assert post.lists[2:] == [("/late", ["a"])]
    while len(post.lists) < 4:
        await asyncio.sleep(0.01)
    assert post.lists[3:] == [("/t", ["a", "b", "c"])]
    assert 0.29 < asyncio.get_running_loop().time() - began < 0.35


async def test_a_slow_node_gets_only_the_newest_of_the_lists_that_wait() -> None:
    post = Post()
    post.push("/t", publishers=["a"])
    await asyncio.sleep(1)
    for number in range(500):
        post.push("/t", publishers=["a", *map(str, range(number))])
    assert post.delivery.waiting == 1
    post.answers.set()
    await post.world.settle()
    assert [len(publishers) for _topic, publishers in post.lists] == [1, 500]


async def test_the_answer_to_a_registration_replaces_a_list_that_waits() -> None:
    """The node would otherwise drop the publishers that the answer has just named."""
    post = Post()
    post.push("/t", publishers=["a"])
    await asyncio.sleep(1)
    post.push("/t", publishers=[])
    post.delivery.answered(post.incarnation, "/t", ("a", "b"))
    post.answers.set()
    await asyncio.sleep(1)
    assert [publishers for _topic, publishers in post.lists] == [["a"], ["b"], ["a", "b"]]


async def test_the_first_publisher_after_an_empty_answer_is_sent_at_once() -> None:
    post = Post()
    post.answers.set()
    post.delivery.answered(post.incarnation, "/t", ())
    post.push("/t", publishers=["a"])
    await asyncio.sleep(0.01)
    assert post.lists == [("/t", ["a"])]


async def test_a_list_that_did_not_arrive_told_no_removal() -> None:
    post = Post(tries=1)
    post.answers.set()
    post.push("/t", publishers=["a", "b"])
    await asyncio.sleep(1)
    post.failure = CallFailedError("it does not answer")
    post.push("/t", publishers=["b"])
    await asyncio.sleep(1)
    post.failure = None
    post.push("/t", publishers=["a", "b"])
    await asyncio.sleep(1)
    assert [publishers for _topic, publishers in post.lists] == [["a", "b"], ["b"], ["a", "b"]]


async def test_a_removal_comes_first_even_if_the_list_of_the_node_is_unknown() -> None:
    """After a takeover, `Delivery` knows no list, and roscpp would ignore an unchanged one."""
    post = Post()
    post.answers.set()
    post.delivery.remove_first(post.incarnation, "/t", frozenset({"a"}))
    post.push("/t", publishers=["a", "b"])
    await asyncio.sleep(1)
    assert [publishers for _topic, publishers in post.lists] == [["b"], ["a", "b"]]


async def test_no_list_is_sent_for_a_topic_that_is_not_subscribed_to_any_more() -> None:
    post = Post()
    post.push("/t", "/other", publishers=["a"])
    await asyncio.sleep(1)
    post.push("/t", "/other", publishers=["a", "b"])
    post.delivery.drop_list(post.incarnation, "/t")
    post.delivery.drop_list(post.incarnation, "/never")
    post.answers.set()
    await post.world.settle()
    assert post.lists == [("/t", ["a"]), ("/other", ["a", "b"])]
    assert (post.delivery.weight, post.delivery.waiting) == (0, 0)


@pytest.mark.parametrize("seed", range(40))
async def test_a_node_sees_each_removal_and_ends_with_the_newest_list(seed: int) -> None:
    random = Random(seed)  # noqa: S311  reproducible
    post = Post(tries=2)
    wanted = {topic: list[Value]() for topic in ("/t", "/u")}
    gone = {topic: set[Value]() for topic in wanted}  # removed since the node was last sent a list

    def received(topic: str, publishers: list[Value]) -> None:
        assert not gone[topic].intersection(publishers), "a publisher returned, and its removal was not told"
        gone[topic].clear()

    post.receives = received
    for _ in range(60):
        topic = random.choice(list(wanted))
        publishers: list[Value] = [one for one in "abcd" if random.random() < 0.6]
        removed = frozenset(one for one in "abcd" if random.random() < 0.1)
        post.delivery.remove_first(post.incarnation, topic, removed)
        gone[topic] |= {one for one in wanted[topic] if one not in publishers} | removed
        wanted[topic] = publishers
        post.delivery.push_list(post.incarnation, topic, tuple(map(str, publishers)))
        assert post.delivery.waiting <= 2
        random.choice((post.answers.set, post.answers.clear))()
        await asyncio.sleep(random.choice((0, 0, 0.05, 0.4)))
    post.answers.set()
    await asyncio.sleep(2)
    assert dict(post.lists) == wanted
    assert (post.delivery.weight, post.delivery.waiting, post.lost) == (0, 0, [])


async def test_a_host_loses_only_its_own_calls() -> None:
    post = Post(queued=Bounds(400_000, 400_000, 0, 0))
    post.push("/a", "/b", publishers=LONG)
    for number in range(200):
        guest = post.node_on("10.0.0.66", f"/guest_{number}")
        post.delivery.push_list(guest, "/t", tuple(LONG[:100]))
    assert post.delivery.weight <= 400_000
    assert post.lost
    assert {name.partition("_")[0] for name, _topic in post.lost} == {"/guest"}
    post.answers.set()
    await post.world.settle()
    assert {"/a", "/b"} <= set(post.heard)


async def test_silent_nodes_delay_no_call_to_other_hosts() -> None:
    post = Post()
    arrived = list[Value]()

    async def answer(node: Incarnation, method: str, parameters: tuple[Value, ...]) -> Value:
        if node.name != "/robot":
            return await post.answer(node, method, parameters)
        arrived.append(parameters[1])
        return [1, "", 0]

    post.world.nodes.answer = answer
    for number in range(2 * NODE_CALLS_UNDER_WAY.bounds.whole):
        guest = post.node_on("10.0.0.66", f"/guest_{number}")
        post.delivery.push_list(guest, "/t", ())
    for _ in range(5):
        await asyncio.sleep(0)
    post.delivery.push_list(post.node_on("10.0.0.5", "/robot"), "/t", ())
    for _ in range(5):
        await asyncio.sleep(0)
    assert arrived == ["/t"]
    assert not post.heard
    post.answers.set()
    await post.world.settle()


async def test_a_question_is_asked_once_in_turn_and_its_answer_may_be_long() -> None:
    post, asked = Post(at_once=Bounds(1, 1, 0, 0)), list[tuple[str, *tuple[Value, ...]]]()

    async def answer(_node: Incarnation, method: str, parameters: tuple[Value, ...]) -> Value:
        asked.append((method, *parameters))
        await post.answers.wait()
        raise CallFailedError("it does not answer")

    post.world.nodes.answer = answer
    questions = [asyncio.create_task(post.delivery.ask(post.incarnation, "getBusInfo")) for _ in range(2)]
    await asyncio.sleep(1.0)
    assert asked == [("getBusInfo", "/master")]  # the other one waits for its turn
    post.answers.set()
    for question in questions:
        with pytest.raises(CallFailedError):
            await question
    assert len(asked) == 2 and [used.limits for used in post.world.nodes.used] == [LONG_ANSWER] * 2
    assert LONG_ANSWER.elements > 7 * 1000
