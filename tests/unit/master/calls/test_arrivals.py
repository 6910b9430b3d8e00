import asyncio
import errno
import os
from collections import deque
from pathlib import Path
from typing import Any

import pytest

from appliance.policy.policy import DEFAULT_PORTS
from appliance.store.state_file import StateStore
from roswire.xmlrpc import Value
from tests.support.control_parts import ControlParts
from tests.support.engines import InlineDatabase

pytestmark = pytest.mark.anyio
_NODES = 4


async def world_with(ports: int) -> ControlParts:
    world = await ControlParts.begun()
    world.places.unused = deque(DEFAULT_PORTS[:ports])
    return world


async def test_a_node_without_a_proxy_endpoint_is_not_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(_port: int) -> Any:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    world = await ControlParts.begun()
    monkeypatch.setattr(world.places, "socket", exhausted)
    answer: Any = await world.ask("registerPublisher", "/n", "/t", "std_msgs/String", "http://10.0.0.5:4000/")
    assert (answer[0], "no proxy endpoint for /n: Too many open files" in answer[1]) == (0, True)
    assert world.registry.all() == []


@pytest.mark.parametrize("count", [2, 8])
@pytest.mark.parametrize(
    ("limit", "reason"),
    [(500, "has 8 ports (2 per node), and 2 are left"), (_NODES, "has 4 nodes, the limit for one host")],
)
async def test_simultaneous_arrivals_do_not_take_each_others_room(
    monkeypatch: pytest.MonkeyPatch, count: int, limit: int, reason: str
) -> None:
    world = await world_with(ports=2 * _NODES + 2)
    monkeypatch.setattr(world.registry, "_most_of_host", limit)

    async def come(number: int) -> Any:
        uri = f"http://10.0.0.5:{4000 + number}/"
        return await world.ask("registerPublisher", f"/n{number}", f"/t{number}", "std_msgs/String", uri)

    for number in range(_NODES - 1):
        assert (await come(number))[0] == 1
    world.go.clear()
    arriving = [asyncio.create_task(come(number)) for number in range(10, 10 + count)]
    await asyncio.sleep(1.0)
    assert sum(task.done() for task in arriving) == count - 1
    world.go.set()
    answers = await asyncio.gather(*arriving)
    assert [answer[0] for answer in answers] == [1] + [0] * (count - 1)
    assert reason in answers[1][1]
    assert [node.name for node in world.registry.all()] == ["/n0", "/n1", "/n2", "/n10"]
    assert not any(node.calls for node in world.registry.all())


async def test_a_node_that_cannot_be_called_may_only_listen() -> None:
    world = await ControlParts.begun()
    world.nodes.gone |= {"/far", "/here"}
    call, uri = ("std_msgs/String",), "http://robot2:4000/"
    await world.ask("registerPublisher", "/voice", "/t", *call, "http://10.0.0.5:4009/")
    for service in ("/far/get_loggers", "/far/set_logger_level", "/far/tf2_frames"):
        assert (await world.ask("registerService", "/far", service, "rosrpc://robot2:5/", uri))[0] == 1  # type: ignore[index]
    assert (await world.ask("registerPublisher", "/far", "/rosout", "rosgraph_msgs/Log", uri))[0] == 1  # type: ignore[index]
    assert [node.name for node in world.registry.live()] == ["/voice"], "these are not registered"
    answer: Any = await world.ask("registerSubscriber", "/far", "/t", *call, uri)
    assert (answer[0], len(answer[2])) == (1, 1)
    for name, *rest in (("registerPublisher", "/t", *call), ("registerService", "/s", "rosrpc://robot2:5/")):
        answer = await world.ask(name, "/far", *rest, uri)
        assert answer[0] == 0
        assert (
            "10.0.0.5 registers /far at http://robot2:4000/, but 10.0.0.1 (the appliance) cannot connect to port 4000"
            in answer[1]
        )
        ways = "admit 10.0.0.1 in that machine's firewall", "--network host", "ROS_IP=10.0.0.5", "a tunnel"
        assert all(way in answer[1] for way in ways)
        assert world.records.pairs[-1] == ("deny", rest[0])
    # A node with another address of its machine in its URI has its port open; the caller's own address needs no check.
    for node, api in (("/near", "http://192.168.1.10:4001/"), ("/here", "http://10.0.0.5:4002/")):
        assert (await world.ask("registerPublisher", node, "/t", *call, api))[0] == 1  # type: ignore[index]  # an answer is a list


@pytest.mark.parametrize("host", ["10.0.0.5", "fd77::5"])
async def test_the_denial_of_a_node_without_ipv6_names_its_variable(host: str) -> None:
    world = await ControlParts.begun()
    world.nodes.gone.add("/far")
    call = ("registerPublisher", "/far", "/t", "std_msgs/String", "http://robot2:4000/")
    answer: Any = await world.ask(*call, host=host)
    assert (answer[0], "ROS_IPV6=on" in answer[1]) == (0, ":" in host)


async def test_a_program_may_listen_a_moment_after_it_registers() -> None:
    world = await ControlParts.begun()
    world.nodes.gone.add("/late")
    asyncio.get_running_loop().call_later(1.0, world.nodes.gone.clear)
    answer: Any = await world.ask(
        "registerPublisher", "/late", "/t", "std_msgs/String", "http://robot2:4000/"
    )
    assert answer[0] == 1, answer


@pytest.mark.parametrize("method", ["registerSubscriber", "registerPublisher"])
async def test_nodes_of_another_master_are_refused(method: str) -> None:
    world = await ControlParts.begun()
    world.nodes.gone.add("/far")
    part: Value = {"methodName": method, "params": ["/far", "/t", "std_msgs/String", "http://robot2:4000/"]}
    answer: Any = await world.ask("system.multicall", [part])
    code, text, _value = answer[0][0]
    assert (code, "multimaster_fkie" in text, world.registry.all()) == (0, True, [])


@pytest.mark.parametrize("lost", [False, True])
async def test_a_node_that_reaches_another_address_gets_its_lists_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: bool
) -> None:
    """The address is stored as well, for the lists after a restart of control."""
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    world = ControlParts(store=store)
    await world.round()
    call, uri = ("std_msgs/String", "http://10.0.0.5:4000/"), "http://10.0.0.5:4001/"
    await world.ask("registerPublisher", "/talker", "/t", call[0], uri)
    await world.ask("registerSubscriber", "/ear", "/t", *call)
    await world.settle()
    if lost:
        world.graph.lost(world.registry.all()[-1], "away")
        await world.settle()
    world.deliveries.told.clear()
    monkeypatch.setattr(world.addresses, "address_for", lambda _peer: "10.0.0.2")
    await world.ask("registerPublisher", "/ear", "/more", *call)
    port = world.registry.all()[0].outer_port
    assert [given for name, _method, given in world.deliveries.told if name == "/ear"] == [
        ("/t", [f"http://10.0.0.2:{port}/"])
    ]
    assert {row.told for row in store.load_registry()[0] if row.name == "/ear"} == {"10.0.0.2"}
    store.close()


async def test_a_refused_node_keeps_no_ports() -> None:
    world = await world_with(ports=2 * _NODES)
    world.nodes.gone.add("/far")
    for _attempt in range(2 * _NODES):
        answer: Any = await world.ask(
            "registerPublisher", "/far", "/t", "std_msgs/String", "http://robot2:4000/"
        )
        assert "cannot connect to port 4000" in answer[1]
    world.sinks.flush()
    assert len(world.places.unused) == 2 * _NODES


async def test_a_node_beyond_a_limit_takes_the_ports_of_one_node(monkeypatch: pytest.MonkeyPatch) -> None:
    world = await ControlParts.begun()
    monkeypatch.setattr(world.registry, "_most_of_host", _NODES - 1)
    for number in range(_NODES - 1):
        uri = f"http://10.0.0.5:{4000 + number}/"
        await world.ask("registerPublisher", f"/n{number}", "/t", "std_msgs/String", uri)
        world.graph.lost(world.registry.all()[-1], "away")
    world.places.unused.clear()
    answer: Any = await world.ask(
        "registerPublisher", "/new", "/t", "std_msgs/String", "http://10.0.0.5:5000/"
    )
    assert answer[0] == 1, answer
    assert [node.name for node in world.registry.all()] == ["/n1", "/n2", "/new"]
