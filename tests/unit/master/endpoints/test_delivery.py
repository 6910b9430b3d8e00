import asyncio
import ipaddress
from typing import Any, cast

import pytest

from appliance.master.endpoints.delivery import Delivery, NodeCall
from appliance.master.graph.registry import Incarnation
from appliance.quotas.pool import Bounds, QuotaClass
from appliance.quotas.table import NODE_CALLS_UNDER_WAY
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import FaultReceived, Value
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
LONG = [f"http://10.0.0.1:{19001 + number}/" for number in range(500)]


class Node:
    def __init__(self) -> None:
        self.answers = asyncio.Event()
        self.fails = False
        self.fault: Exception | None = None
        self.heard: list[Value] = []

    async def call(self, _method: str, _caller: str, *parameters: Value) -> None:
        await self.answers.wait()
        if self.fails:
            raise CallFailedError("it does not answer") from self.fault
        self.heard.append(parameters[0])


class Post:
    def __init__(self, **bounds: Any) -> None:
        self.node, self.lost = Node(), list[tuple[str, Value]]()
        self.world = ControlParts()
        self.delivery = Delivery(
            self.world.nodes,
            troubled=self._troubled,
            quota_class=lambda _host: QuotaClass.REGISTERED,
            **bounds,
        )
        cast(Any, self.world.nodes).call = lambda _incarnation, *call: self.node.call(*call)
        self.incarnation = self.world.node("/n")

    def _troubled(self, incarnation: Incarnation, call: NodeCall, _why: str) -> None:
        self.lost.append((incarnation.name, call.parameters[0]))

    def node_on(self, host: str, name: str) -> Incarnation:
        node = self.world.node(name)
        node.host = ipaddress.ip_address(host)
        return node

    def push(self, *topics: str, publishers: list[str]) -> None:
        for topic in topics:
            self.delivery.push(self.incarnation, NodeCall("publisherUpdate", (topic, list(publishers))))


async def test_lists_of_publishers_are_bounded_in_bytes() -> None:
    post = Post(queued=Bounds(100_000, 100_000, 0, 0))
    post.push(*(f"/t{number}" for number in range(50)), publishers=LONG)
    assert post.delivery.waiting < 8
    assert len(post.lost) == 50 - post.delivery.waiting
    post.node.answers.set()
    await post.world.settle()
    assert len(post.node.heard) < 8
    assert post.node.heard[-1] == "/t49"
    assert post.delivery.weight == 0


async def test_a_dropped_queue_frees_its_bytes() -> None:
    post = Post()
    post.push("/a", "/b", publishers=LONG)
    assert post.delivery.weight > 20_000
    post.delivery.drop(post.incarnation)
    assert (post.delivery.weight, post.delivery.waiting) == (0, 0)
    post.node.answers.set()
    await post.world.settle()


async def test_a_call_that_stays_undelivered_is_reported() -> None:
    post = Post(tries=2)
    post.node.fails = True
    post.node.answers.set()
    post.push("/a", publishers=[])
    await post.world.settle()
    assert post.lost == [("/n", "/a")]


async def test_a_call_that_a_node_answers_with_a_fault_has_arrived() -> None:
    post = Post(tries=2)
    post.node.fails, post.node.fault = True, FaultReceived(1, "not for me")
    post.node.answers.set()
    post.push("/a", publishers=[])
    await post.world.settle()
    assert post.lost == []


async def test_a_publisher_is_added_some_time_after_its_removal() -> None:
    post = Post()
    post.node.answers.set()
    for publishers in ([], ["a"], ["a", "b"], ["a"], ["a", "b", "c"]):
        post.push("/t", publishers=publishers)
    post.push("/other", publishers=["a"])
    times, began = dict[int, float](), asyncio.get_running_loop().time()
    while len(post.node.heard) < 6:
        await asyncio.sleep(0.01)
        times.setdefault(len(post.node.heard), asyncio.get_running_loop().time() - began)
    assert post.node.heard == ["/t", "/other", "/t", "/t", "/t", "/t"]
    assert [count for count, at in times.items() if at < 0.25] == [2]
    assert [count for count, at in times.items() if at < 0.55] == [2, 5]


async def test_a_host_loses_only_its_own_calls() -> None:
    post = Post(queued=Bounds(400_000, 400_000, 0, 0))
    post.push("/a", "/b", publishers=LONG)
    for number in range(200):
        guest = post.node_on("10.0.0.66", f"/guest_{number}")
        post.delivery.push(guest, NodeCall("publisherUpdate", ("/t", list[Value](LONG[:100]))))
    assert post.delivery.weight <= 400_000
    assert post.lost
    assert {name.partition("_")[0] for name, _topic in post.lost} == {"/guest"}
    post.node.answers.set()
    await post.world.settle()
    assert {"/a", "/b"} <= set(post.node.heard)


async def test_silent_nodes_delay_no_call_to_other_hosts() -> None:
    post = Post()
    robot = Node()
    robot.answers.set()
    cast(Any, post.world.nodes).call = lambda incarnation, *call: (
        robot if incarnation.name == "/robot" else post.node
    ).call(*call)
    for number in range(2 * NODE_CALLS_UNDER_WAY.bounds.whole):
        guest = post.node_on("10.0.0.66", f"/guest_{number}")
        post.delivery.push(guest, NodeCall("publisherUpdate", ("/t", [])))
    for _ in range(5):
        await asyncio.sleep(0)
    post.delivery.push(post.node_on("10.0.0.5", "/robot"), NodeCall("publisherUpdate", ("/t", [])))
    for _ in range(5):
        await asyncio.sleep(0)
    assert robot.heard == ["/t"]
    assert not post.node.heard
    post.node.answers.set()
    await post.world.settle()
