"""The queues of calls to nodes: their bounds, and what becomes of a call that does not arrive."""

import asyncio
from typing import Any, cast

import pytest

from appliance.master.client import CallFailedError
from appliance.master.delivery import Delivery, NodeCall
from appliance.master.registry import Incarnation
from appliance.ros.xmlrpc import FaultReceived, Limits, Value
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
LONG = [f"http://10.0.0.1:{19001 + number}/" for number in range(500)]


class Node:
    """The node that is called: it answers once `answers` is set, and fails while `fails`."""

    def __init__(self) -> None:
        self.answers = asyncio.Event()
        self.fails = False
        self.fault: Exception | None = None
        self.heard: list[Value] = []

    async def call(self, _method: str, _caller: str, *parameters: Value) -> None:
        """As `XmlRpcClient`."""
        await self.answers.wait()
        if self.fails:
            raise CallFailedError("it does not answer") from self.fault
        self.heard.append(parameters[0])


class Post:
    """A delivery to one node, and what could not be delivered."""

    def __init__(self, **bounds: int) -> None:
        self.node, self.lost = Node(), list[tuple[str, Value]]()
        self.delivery = Delivery(timeout=1.0, limits=Limits(), troubled=self._troubled, **bounds)
        cast(Any, self.delivery).client = lambda _incarnation: self.node
        self.world = ControlParts()
        self.incarnation = self.world.node("/n")

    def _troubled(self, incarnation: Incarnation, call: NodeCall, _why: str) -> None:
        self.lost.append((incarnation.name, call.parameters[0]))

    def push(self, *topics: str, publishers: list[str]) -> None:
        """A list of publishers for each of these topics."""
        for topic in topics:
            self.delivery.push(self.incarnation, NodeCall("publisherUpdate", (topic, list(publishers))))


async def test_lists_of_publishers_are_bounded_in_bytes() -> None:
    """What waits for a node that stands still has a bound, whatever it is made of; it is told what was dropped."""
    post = Post(bound_bytes=100_000)
    post.push(*(f"/t{number}" for number in range(50)), publishers=LONG)
    assert post.delivery.waiting < 8
    assert len(post.lost) == 50 - post.delivery.waiting
    post.node.answers.set()
    await post.world.settle()
    assert len(post.node.heard) < 8
    assert post.node.heard[-1] == "/t49"
    assert post.delivery.weight == 0


async def test_a_queue_that_is_dropped_frees_its_room() -> None:
    """The node is gone: nothing of its queue counts any more."""
    post = Post()
    post.push("/a", "/b", publishers=LONG)
    assert post.delivery.weight > 20_000
    post.delivery.drop(post.incarnation)
    assert (post.delivery.weight, post.delivery.waiting) == (0, 0)
    post.node.answers.set()
    await post.world.settle()


async def test_a_call_that_stays_undelivered_is_reported() -> None:
    """After the last try whoever looks after the node hears which call is lost."""
    post = Post(tries=2)
    post.node.fails = True
    post.node.answers.set()
    post.push("/a", publishers=[])
    await post.world.settle()
    assert post.lost == [("/n", "/a")]


async def test_a_call_that_a_node_answers_with_a_fault_has_arrived() -> None:
    """It is not told the same for ever: saying it again later would get the same answer."""
    post = Post(tries=2)
    post.node.fails, post.node.fault = True, FaultReceived(1, "not for me")
    post.node.answers.set()
    post.push("/a", publishers=[])
    await post.world.settle()
    assert post.lost == []
