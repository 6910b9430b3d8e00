"""Updates of parameters to nodes that perhaps never asked for them: they cost little, and delay nothing."""

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from appliance.master.endpoints.delivery import UnaskedCalls
from appliance.master.graph.registry import Incarnation
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import Value
from tests.support.incarnations import incarnation

pytestmark = pytest.mark.anyio
TAKEN: Value = [1, "", 0]
FOREIGN: Value = [-1, "not subscribed", 0]


@dataclass
class Robot:
    """Nodes that answer to a call of a key as `answer` says."""

    answer: Callable[[str, str], Value] = lambda _node, _key: TAKEN
    silent: set[str] = field(default_factory=set)
    got: list[tuple[str, str, int]] = field(default_factory=list)
    tried: Counter[str] = field(default_factory=Counter)

    async def call(self, node: Incarnation, call: tuple[str, int]) -> Value:
        self.tried[node.name] += 1
        if node.name in self.silent:
            await asyncio.sleep(3)
            raise CallFailedError("no answer")
        await asyncio.sleep(0.001)
        self.got.append((node.name, *call))
        return self.answer(node.name, call[0])


async def test_a_node_gets_the_newest_value_of_a_key_that_changes_without_a_pause() -> None:
    robot = Robot()
    calls = UnaskedCalls(robot.call)
    for number in range(1000):
        calls.push(incarnation("/cpp"), "/speed", ("/speed", number))
        await asyncio.sleep(0.005)
    await asyncio.sleep(1)
    assert robot.got[-1] == ("/cpp", "/speed", 999)
    assert len(robot.got) < 40


async def test_a_key_to_which_a_node_did_not_subscribe_is_sent_once() -> None:
    robot = Robot(lambda _node, _key: FOREIGN)
    calls = UnaskedCalls(robot.call)
    for number in range(10):
        calls.push(incarnation("/py"), "/a/b", ("/a/b", number))
        await asyncio.sleep(1)
    assert robot.got == [("/py", "/a/b", 0)]


async def test_a_key_is_sent_again_after_its_namespace_was_taken() -> None:
    """rospy knows a new part of a namespace only with the namespace."""
    robot = Robot(lambda _n, key: TAKEN if key == "/a" else FOREIGN)
    calls = UnaskedCalls(robot.call)
    for key in ("/a/b", "/a", "/a/b"):
        calls.push(incarnation("/py"), key, (key, 1))
        await asyncio.sleep(1)
    keys = [key for _node, key, _n in robot.got]
    assert keys == ["/a/b", "/a", "/a/b"]


@pytest.mark.parametrize("others", [1, 50])
async def test_nodes_that_never_answer_get_nothing_more_and_others_do(others: int) -> None:
    robot = Robot(silent={"/js"})
    calls = UnaskedCalls(robot.call)
    for number in range(600):
        for name in ("/js", *(f"/cpp{one}" for one in range(others))):
            calls.push(incarnation(name), "/speed", ("/speed", number))
        await asyncio.sleep(0.1)
    await asyncio.sleep(5)
    assert robot.tried["/js"] == 5
    last = {name: number for name, _key, number in robot.got}
    assert last == {f"/cpp{one}": 599 for one in range(others)}


async def test_a_node_that_hangs_for_some_seconds_gets_the_newest_value_afterwards() -> None:
    robot = Robot(silent={"/cpp"})
    calls = UnaskedCalls(robot.call)
    for number in range(8):
        calls.push(incarnation("/cpp"), "/speed", ("/speed", number))
        await asyncio.sleep(1)
    robot.silent.clear()
    await asyncio.sleep(5)
    assert robot.got == [("/cpp", "/speed", 7)]


async def test_nothing_is_sent_after_the_end() -> None:
    robot = Robot()
    calls = UnaskedCalls(robot.call)
    for number in range(3):
        calls.push(incarnation(f"/{number}"), "/speed", ("/speed", number))
    calls.drop(incarnation("/0"))
    calls.clear()
    await asyncio.sleep(10)
    assert robot.got == []


async def test_nodes_of_a_host_that_never_answer_delay_no_node_of_another() -> None:
    robot = Robot(silent={f"/a{number}" for number in range(500)})
    calls = UnaskedCalls(robot.call)
    for number in range(500):
        calls.push(incarnation(f"/a{number}", host="10.0.0.66"), "/speed", ("/speed", 1))
    calls.push(incarnation("/base"), "/speed", ("/speed", 1))
    await asyncio.sleep(1)
    assert [name for name, *_value in robot.got] == ["/base"]
    calls.clear()
