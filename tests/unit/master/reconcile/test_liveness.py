import asyncio
import ipaddress

import pytest

from appliance.base.clock import using
from appliance.channel import messages
from appliance.configuration import settings
from appliance.master.graph.registry import Incarnation, Kind, Life
from appliance.master.reconcile import liveness
from appliance.master.reconcile.liveness import Presence
from appliance.rpc.xmlrpc_client import NoRouteError, RefusedError, UnansweredError, XmlRpcClient
from roswire.uris import NodeUri
from roswire.xmlrpc import Value, build_fault, build_response
from tests.support.control_parts import HOST, OPEN, POLICY, ControlParts
from tests.support.scripted_nodes import Answer
from tests.support.virtual_clock import ShiftedClock

pytestmark = pytest.mark.anyio


async def with_a_node() -> tuple[ControlParts, Incarnation]:
    """Return a world with a node `/n`, which publishes /a."""
    world = await ControlParts.begun()
    node = world.node("/n")
    await world.register(node, Kind.PUBLICATION, "/a")
    return world, node


async def test_a_clock_that_is_set_forward_forgets_no_node() -> None:
    world, node = await with_a_node()
    world.nodes.silent = {"/n"}
    await world.look(node)
    with using(ShiftedClock(365 * 86_400)):
        await world.look(node)
        world.nodes.silent = set()
        await world.look(node)
    assert (node.life, world.hidden.has(Kind.PUBLICATION, "/a")) == (Life.LIVE, ["/n"])


async def test_a_node_that_was_lost_for_a_moment_returns_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(liveness, "RECENTLY_LOST_SECONDS", 0.0)
    world, node = await with_a_node()
    world.nodes.silent = {"/n"}
    await world.look(node)
    assert world.lives == [Life.SHADOW]
    world.nodes.silent = set()
    running = asyncio.create_task(world.liveness.run())
    try:
        async with asyncio.timeout(world.liveness.settings.interval / 2):
            while world.lives != [Life.LIVE]:
                await asyncio.sleep(0)
    finally:
        running.cancel()


@pytest.mark.parametrize(("own", "ended"), [(True, False), (True, True), (False, False)])
async def test_only_a_rosout_that_hangs_is_restarted(
    monkeypatch: pytest.MonkeyPatch, *, own: bool, ended: bool
) -> None:
    """Another node is not ours, and the supervisor restarts a process that has ended."""
    monkeypatch.setattr(liveness, "_LOOK_AGAIN_SECONDS", 0.0)
    world, node = await with_a_node()
    told: list[str] = []
    world.liveness.own_silent = lambda: told.append("silent")
    node.own = own
    if ended:
        world.nodes.gone = {"/n"}
    else:
        world.nodes.silent = {"/n"}
    await world.look(node)
    assert (node.life, told) == (Life.SHADOW, ["silent"] * (own and not ended))


async def test_a_refusal_of_a_robot_that_shuts_out_loses_no_node(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(liveness, "_LOOK_AGAIN_SECONDS", 0.0)
    world = ControlParts(silent=3600.0)
    await world.round()
    ear, mouth = world.node("/ear", 1), world.node("/mouth", 2)
    await world.register(ear, Kind.SUBSCRIPTION, "/t")
    await world.register(mouth, Kind.PUBLICATION, "/t")
    world.deliveries.told.clear()
    world.shut_out, world.nodes.gone = True, {"/ear"}
    assert (await world.liveness.probe(ear)).presence is Presence.SILENT
    world.watchlist.cut_off(ear, "/t")
    world.liveness.look_at_watched()
    await world.settle()
    assert (world.lives, world.deliveries.told) == ([Life.LIVE, Life.LIVE], [])
    world.shut_out, world.nodes.gone = False, set()
    await asyncio.sleep(2 * liveness.RECENTLY_LOST_SECONDS)
    assert len(world.deliveries.told) == 2
    world.nodes.gone = {"/ear"}
    await world.look(ear)
    assert world.lives == [Life.SHADOW, Life.LIVE]


async def test_a_node_that_lost_all_registrations_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(liveness, "_IDLE_SECONDS", 0.0)
    world = await ControlParts.begun()
    node, idle = world.node("/n", 1), world.node("/idle", 2)
    await world.register(node, Kind.PUBLICATION, "/secret")
    world.reload(POLICY.format("/secret=\n", ""))
    await world.settle()
    world.nodes.silent = {"/n", "/idle"}
    await world.look(node)
    await world.look(idle)
    assert world.registry.all() == [node]
    world.reload(OPEN)
    world.nodes.silent = set()
    await world.look(node)
    assert world.lives == [Life.LIVE]
    assert world.hidden.has(Kind.PUBLICATION, "/secret") == ["/n"]


async def test_a_node_that_returns_during_its_removal_is_registered_again() -> None:
    world = await ControlParts.begun()
    node = world.node("/n")
    for topic in ("/a", "/b", "/c"):
        await world.register(node, Kind.PUBLICATION, topic)
    world.nodes.silent = {"/n"}
    world.hidden.go.clear()
    await world.liveness.look(node)
    assert node.life is Life.SHADOW
    await asyncio.sleep(1.0)
    world.nodes.silent = set()
    world.liveness.revive(node)
    await asyncio.sleep(1.0)
    world.hidden.go.set()
    await world.settle()
    assert [call[0] for call in world.hidden.calls if call[0] == "unregisterPublisher"]
    assert [world.hidden.has(Kind.PUBLICATION, topic) for topic in ("/a", "/b", "/c")] == [["/n"]] * 3


async def test_a_node_that_returns_to_a_new_master_is_restored_by_the_rebuild() -> None:
    world, node = await with_a_node()
    world.nodes.silent = {"/n"}
    await world.look(node)
    world.rosmaster.shut()
    world.hidden.restart()
    world.liveness.revive(node)
    await world.round()
    assert world.hidden.has(Kind.PUBLICATION, "/a") == ["/n"]


async def test_silent_nodes_delay_no_check_of_other_hosts() -> None:
    world = await ControlParts.begun()
    silence = asyncio.Event()
    robot = world.node("/robot", 1)
    await world.register(robot, Kind.PUBLICATION, "/t")
    guests = [world.node(f"/guest_{number}", 2 + number) for number in range(450)]
    for guest in guests:
        guest.host = ipaddress.ip_address("10.0.0.66")

    async def answer(node: Incarnation, _method: str, _parameters: tuple[Value, ...]) -> Value:
        if node is robot:
            raise RefusedError("nobody is there")
        await silence.wait()
        return [1, "", 1]

    world.nodes.answer = answer
    for guest in guests:
        world.liveness.look_at(guest)
    for _ in range(5):
        await asyncio.sleep(0)
    world.liveness.look_at(robot)
    while robot.life is Life.LIVE:
        await asyncio.sleep(1)
    silence.set()
    await world.settle()


@pytest.mark.parametrize("kind", [Kind.SUBSCRIPTION, Kind.PUBLICATION])
async def test_a_node_that_was_never_reached_is_there_while_it_is_connected(
    monkeypatch: pytest.MonkeyPatch, kind: Kind
) -> None:
    monkeypatch.setattr(liveness, "_LOOK_AGAIN_SECONDS", 0.0)
    world = ControlParts(silent=20.0)
    await world.round()
    node, voice = world.node("/n"), world.node("/voice", 2)
    await world.register(voice, Kind.PUBLICATION, "/t")
    await world.register(node, kind, "/t")
    world.nodes.gone.add("/n")
    world.carried.opened(0, messages.ConnectionOpened(1, voice.key, "/t", "topic", str(node.host), "/n"))
    await world.look(node)
    if kind is Kind.PUBLICATION:
        assert node.life is Life.SHADOW, "a publisher must answer"
        return
    assert (node.life, node.reached) == (Life.LIVE, False)
    assert (await world.liveness.probe(node)).presence is Presence.ANSWERS
    world.carried.lost(0)
    assert (await world.liveness.probe(node)).presence is Presence.GONE
    await world.look(node)
    assert node.life is Life.LIVE, "it may connect again"
    world.liveness.settings = settings.LivenessSection(silent=0.0)
    await world.look(node)
    assert world.records.pairs[-1][0] == "node lost"
    assert sorted(world.lives) == [Life.LIVE, Life.SHADOW], "it may connect again within a day"


async def test_a_listener_that_ended_is_forgotten_while_its_next_start_is_connected() -> None:
    world = ControlParts(silent=20.0)
    await world.round()
    first, voice = world.node("/n"), world.node("/voice", 2)
    await world.register(voice, Kind.PUBLICATION, "/t")
    await world.register(first, Kind.SUBSCRIPTION, "/t")
    world.registry.unregister(first, Kind.SUBSCRIPTION, "/t")
    world.nodes.gone.add("/n")
    second = world.node("/n", 3)
    await world.register(second, Kind.SUBSCRIPTION, "/t")
    world.carried.opened(0, messages.ConnectionOpened(1, voice.key, "/t", "topic", str(first.host), "/n"))
    await asyncio.sleep(31)
    await world.look(first)
    await world.look(second)
    assert (first.life, second.life) == (Life.FORGOTTEN, Life.LIVE)


@pytest.mark.parametrize("registers", [False, True])
async def test_a_node_that_answers_later_gets_what_it_missed(registers: bool) -> None:
    world = ControlParts(silent=20.0)
    await world.round()
    node, voice = world.node("/n"), world.node("/voice", 2)
    await world.register(node, Kind.SUBSCRIPTION, "/t")
    node.reached = False
    await world.register(voice, Kind.PUBLICATION, "/t")
    await world.settle()
    world.deliveries.told.clear()
    if registers:
        assert await world.ask("registerPublisher", "/n", "/more", "std_msgs/String", node.api_text)
        await world.settle()
    else:
        await world.look(node)
    assert node.reached
    assert {method for name, method, _given in world.deliveries.told if name == "/n"} == {"publisherUpdate"}


@pytest.mark.parametrize("more", [None, "/rosout", "/initialpose"])
@pytest.mark.parametrize("reached", [None, False, True])
@pytest.mark.parametrize("away", [0.0, 1000.0])
async def test_a_subscriber_keeps_its_grants_while_it_is_connected(
    more: str | None, reached: bool | None, away: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its firewall refuses calls, and its link was away for a while: its client never asks for another grant."""
    monkeypatch.setattr(liveness, "_LOOK_AGAIN_SECONDS", 0.0)
    world = ControlParts(silent=20.0)
    await world.round()
    ear, voice = world.node("/ear"), world.node("/voice", 2)
    await world.register(voice, Kind.PUBLICATION, "/t")
    await world.register(ear, Kind.SUBSCRIPTION, "/t")
    if more is not None:
        await world.register(ear, Kind.PUBLICATION, more)
        await world.register(ear, Kind.SERVICE, "/ear/get_loggers")
    world.graph.topic_granted(voice, "/t", HOST, "/ear")
    ear.reached = reached
    world.nodes.gone.add("/ear")
    if away:
        await world.look(ear)
        await asyncio.sleep(20.0)
        await world.look(ear)
        assert ear.life is Life.SHADOW
    comes_back = reached is not True and more != "/initialpose"
    await asyncio.sleep(away if comes_back else 0.0)
    world.carried.opened(0, messages.ConnectionOpened(1, voice.key, "/t", "topic", str(HOST), "/ear"))
    for _check in range(3):
        await world.look(ear)
        assert len(world.grants.all()) == 1
        await asyncio.sleep(world.liveness.settings.shadow + 1.0)
    assert ear.life is (Life.LIVE if comes_back else Life.SHADOW)
    world.reload(POLICY.format("", "/t=\n"))
    await world.settle()
    assert (world.grants.all(), [*ear.shelf]) == ([], [(Kind.SUBSCRIPTION, "/t")]), "the policy decides"
    world.carried.lost(0)
    await asyncio.sleep(86_401.0)
    await world.look(ear)
    assert ear.life is not Life.LIVE


async def _refuses(_node: Incarnation, _method: str, _parameters: tuple[Value, ...]) -> Value:
    raise RefusedError("Connection refused")


async def _has_no_route(_node: Incarnation, _method: str, _parameters: tuple[Value, ...]) -> Value:
    raise NoRouteError("No route to host")


async def _is_silent(_node: Incarnation, _method: str, _parameters: tuple[Value, ...]) -> Value:
    raise UnansweredError("no answer")


async def _is_another_process(_node: Incarnation, _method: str, _parameters: tuple[Value, ...]) -> Value:
    return [1, "", 77]


def _replies(status: str, body: bytes) -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


@pytest.mark.usefixtures("local_sockets")
@pytest.mark.parametrize(
    ("reply", "stays"),
    [
        (_replies("200 OK", build_response([1, "", 7])), True),
        (_replies("200 OK", build_response([0, "no", -1])), True),
        (_replies("200 OK", build_response([])), True),
        (_replies("200 OK", build_fault(1, 'method "getPid" is not supported')), True),
        (_replies("501 Not Implemented", b""), False),
        (_replies("200 OK", b"<html></html>"), False),
        (None, False),
    ],
    ids=["process", "failure", "nothing", "fault", "501", "html", "silence"],
)
async def test_only_silence_refusal_and_another_program_lose_a_node(reply: bytes | None, stays: bool) -> None:
    world, node = await with_a_node()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"</methodCall>")
        if reply is None:
            await asyncio.sleep(2.0)
        writer.write(reply or _replies("200 OK", b""))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    client = XmlRpcClient(NodeUri("http", "127.0.0.1", server.sockets[0].getsockname()[1], "/"), timeout=1.0)

    async def answer(_node: Incarnation, method: str, parameters: tuple[Value, ...]) -> Value:
        return await client.call(method, *parameters)

    world.nodes.answer = answer
    await world.liveness.look(node)
    server.close()
    await asyncio.sleep(3.0)  # until the connection is closed
    assert (node.life is Life.LIVE) == stays


@pytest.mark.parametrize(
    ("answer", "ended"),
    [(_refuses, True), (_is_another_process, True), (_has_no_route, False), (_is_silent, False)],
)
async def test_a_node_that_may_live_is_registered_again_for_a_day(
    answer: Answer, ended: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A laptop is suspended over lunch, or a robot drives out of reach: their nodes never register again."""
    monkeypatch.setattr(liveness, "_LOOK_AGAIN_SECONDS", 0.0)
    world, node = await with_a_node()
    await world.look(node)
    answers, world.nodes.answer = world.nodes.answer, answer
    await world.look(node)
    assert world.lives == [Life.SHADOW]
    await asyncio.sleep(world.liveness.settings.shadow + 1.0)
    await world.look(node)
    assert world.lives == ([] if ended else [Life.SHADOW])
    world.nodes.answer = answers
    await world.look(node)
    assert world.hidden.has(Kind.PUBLICATION, "/a") == ([] if ended else ["/n"])
    if not ended:
        world.nodes.answer = answer
        await world.look(node)
        await asyncio.sleep(86_401.0)
        await world.look(node)
        assert world.lives == []
