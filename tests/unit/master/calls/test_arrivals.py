import asyncio
from typing import Any, cast

import pytest

from appliance.master.calls.registration import Arrivals
from appliance.master.endpoints import node_ports
from appliance.master.endpoints.node_ports import NodePorts, NoPortError
from appliance.master.graph.registry import Incarnation, Registry
from appliance.master.reconcile.sinks import ProxyEndpoints
from appliance.policy.model import Address
from appliance.policy.policy_compiler import compile_policy
from tests.support.control_parts import ControlParts

pytestmark = pytest.mark.anyio
_NODES = 4


def _serve(_incarnation: Incarnation) -> Any:
    return None


class FewPorts:
    def __init__(self, registry: Registry) -> None:
        self._registry = registry

    def open(self, _host: Address) -> tuple[int, ...]:
        taken = {port for node in self._registry.all() for port in node.ports}
        free = [port for port in range(1, 2 * _NODES + 1) if port not in taken]
        if not free:
            raise NoPortError("all ports are in use")
        return tuple(free[:2])


class SlowFaces:
    async def open(self, _incarnation: Incarnation, _handler: object) -> None:
        for _turn in range(3):
            await asyncio.sleep(0)


class NoFaces:
    async def open(self, incarnation: Incarnation, _handler: object) -> None:
        raise NoPortError(f"no proxy endpoint for {incarnation.name}: Too many open files")


async def world_with(faces: NoFaces | SlowFaces) -> ControlParts:
    world = await ControlParts.begun()
    arrivals = Arrivals(
        world.registry,
        world.graph,
        world.sinks.flush,
        world.liveness,
        places=cast(Any, FewPorts(world.registry)),
        faces=cast(Any, faces),
        addresses=cast(Any, world.addresses),
        serve=_serve,
    )
    cast(Any, world.faces).incarnation_for = arrivals.incarnation_for
    return world


async def test_a_node_without_a_proxy_endpoint_is_not_registered() -> None:
    world = await world_with(NoFaces())
    answer: Any = await world.ask("registerPublisher", "/n", "/t", "std_msgs/String", "http://10.0.0.5:4000/")
    assert (answer[0], "no proxy endpoint for /n: Too many open files" in answer[1]) == (0, True)
    assert world.registry.all() == []


@pytest.mark.parametrize("count", [2, 8])
@pytest.mark.parametrize(
    ("limit", "reason"), [(500, "all ports are in use"), (_NODES, "has 4 nodes, the limit for one host")]
)
async def test_simultaneous_arrivals_do_not_take_each_others_room(
    monkeypatch: pytest.MonkeyPatch, count: int, limit: int, reason: str
) -> None:
    world = await world_with(SlowFaces())
    monkeypatch.setattr(world.registry, "_most_of_host", limit)

    async def come(number: int) -> Any:
        uri = f"http://10.0.0.5:{4000 + number}/"
        return await world.ask("registerPublisher", f"/n{number}", f"/t{number}", "std_msgs/String", uri)

    for number in range(_NODES - 1):
        assert (await come(number))[0] == 1
    async with asyncio.timeout(10):
        answers = await asyncio.gather(*(come(number) for number in range(10, 10 + count)))
    assert [answer[0] for answer in answers] == [1] + [0] * (count - 1)
    assert reason in answers[1][1]
    assert [node.name for node in world.registry.all()] == ["/n0", "/n1", "/n2", "/n10"]
    assert not any(node.calls for node in world.registry.all())


async def test_a_node_of_another_machine_is_refused() -> None:
    world = await world_with(SlowFaces())
    world.clients.gone |= {"/far", "/here"}
    call = ("/t", "std_msgs/String")
    answer: Any = await world.ask("registerPublisher", "/far", *call, "http://robot2:4000/")
    assert answer[0] == 0
    assert (
        "10.0.0.5 registers /far at http://robot2:4000/, but has no node on port 4000: a node registers"
        in answer[1]
    )
    assert world.records.pairs[-1] == ("deny", "/t")
    assert world.registry.all() == []
    # A node with another address of its machine in its URI has its port open; the caller's own address needs no check.
    for node, uri in (("/near", "http://192.168.1.10:4001/"), ("/here", "http://10.0.0.5:4002/")):
        assert (await world.ask("registerPublisher", node, *call, uri))[0] == 1  # type: ignore[index]  # an answer is a list


@pytest.mark.parametrize("lost", [False, True])
async def test_a_node_that_reaches_another_address_gets_its_lists_with_it(
    monkeypatch: pytest.MonkeyPatch, lost: bool
) -> None:
    """The address is stored as well, for the lists after a restart of control."""
    world = await world_with(SlowFaces())
    stored = list[str]()
    monkeypatch.setattr(world.store, "save_incarnation", lambda row: stored.append(row.told))
    call, uri = ("std_msgs/String", "http://10.0.0.5:4000/"), "http://10.0.0.5:4001/"
    await world.ask("registerPublisher", "/talker", "/t", call[0], uri)
    await world.ask("registerSubscriber", "/ear", "/t", *call)
    await world.settle()
    if lost:
        world.graph.lost(world.registry.all()[-1], "away")
        await world.settle()
    world.deliveries.told.clear()
    stored.clear()
    monkeypatch.setattr(world.addresses, "address_for", lambda _peer: "10.0.0.2")
    await world.ask("registerPublisher", "/ear", "/more", *call)
    port = world.registry.all()[0].outer_port
    assert [given for name, _method, given in world.deliveries.told if name == "/ear"] == [
        ("/t", [f"http://10.0.0.2:{port}/"])
    ]
    assert set(stored) == {"10.0.0.2"}


class Listening:
    def __init__(self, _host: str, port: int) -> None:
        self.port = port

    def getsockname(self) -> tuple[str, int]:
        return "10.0.0.1", self.port

    def dup(self) -> "Listening":
        return self

    async def start(self) -> None:
        await asyncio.sleep(0)

    def close(self) -> None: ...


NAMING = compile_policy("", file="a.ini")


async def world_with_ports(monkeypatch: pytest.MonkeyPatch) -> tuple[ControlParts, NodePorts]:
    monkeypatch.setattr(node_ports, "listen", Listening)
    world = await ControlParts.begun()
    places = NodePorts(
        "10.0.0.1", range(1, 1 + 2 * _NODES), keep=lambda *_: None, drop=lambda _: None,
        policy=lambda: NAMING,
    )  # fmt: skip
    faces = ProxyEndpoints(world.registry, places, 9, lambda sock, _: cast(Any, sock))
    arrivals = Arrivals(
        world.registry,
        world.graph,
        world.sinks.flush,
        world.liveness,
        places,
        faces,
        cast(Any, world.addresses),
        _serve,
    )
    monkeypatch.setattr(world.faces, "incarnation_for", arrivals.incarnation_for)
    monkeypatch.setattr(world.faces, "close", faces.close)
    return world, places


async def test_a_refused_node_keeps_no_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    world, places = await world_with_ports(monkeypatch)
    world.clients.gone.add("/far")
    for _attempt in range(2 * _NODES):
        answer: Any = await world.ask(
            "registerPublisher", "/far", "/t", "std_msgs/String", "http://robot2:4000/"
        )
        assert "has no node on port 4000" in answer[1]
    world.sinks.flush()
    assert len(places.unused) == 2 * _NODES


async def test_a_node_beyond_a_limit_takes_the_ports_of_one_node(monkeypatch: pytest.MonkeyPatch) -> None:
    world, places = await world_with_ports(monkeypatch)
    monkeypatch.setattr(world.registry, "_most_of_host", _NODES - 1)
    for number in range(_NODES - 1):
        uri = f"http://10.0.0.5:{4000 + number}/"
        await world.ask("registerPublisher", f"/n{number}", "/t", "std_msgs/String", uri)
        world.graph.lost(world.registry.all()[-1], "away")
    places.unused.clear()
    answer: Any = await world.ask(
        "registerPublisher", "/new", "/t", "std_msgs/String", "http://10.0.0.5:5000/"
    )
    assert answer[0] == 1, answer
    assert [node.name for node in world.registry.all()] == ["/n1", "/n2", "/new"]
