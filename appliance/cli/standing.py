"""Wait until a robot stands still: before its protection is changed, a person wants to see that it does not move.

1. A robot stands if the last command of each of its command topics was zero, and, where it measures its own speed, that
   was zero too, both for some seconds.
2. Silence is not standing: without a commanded zero, or while odometry is silent, the robot is not known to stand. A
   topic without a command may stand beside another with a zero if each of its drivers measures zero; it is named.
3. Only topics of the robot count: its nodes drive by them, or publish them to a driver elsewhere. Topics of other hosts
   neither prevent nor prove anything; they are named.
4. The wait has an end, with a reason.
5. Motions that no such topic reports are not seen: an arm, a base with other messages, and without odometry the real
   speed. The answer names it.
"""

import asyncio
import math
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import typer

from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.host_names import addresses_of
from appliance.channel.admin import AdminRequest, GraphWanted, PolicyWanted
from appliance.channel.answers.graph_answers import Graph
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.channel.operations import request_named
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.cli.connection.target import Appliance
from appliance.cli.durations import bounded_span
from appliance.cli.output import usage_error
from appliance.cli.robot_motions import (
    STILL_SECONDS,
    MotionTopics,
    StandingJudge,
    motion_topics,
    some,
    speed_in,
    speed_of,
    unseen,
)
from appliance.network.close_ports import LINK
from appliance.network.interfaces import addresses_by_interface
from appliance.network.namespaces import Namespace
from appliance.rpc.graph_reader import is_here
from appliance.rpc.master_reader import PUBLICATION, SUBSCRIPTION, MasterGraph, MasterReader, MasterReadError
from rosmop.tool.terminal import printable, refusal, say
from roswire.errors import RosError
from roswire.node.network import SourceNetwork
from roswire.node.ros_node import RosNode
from roswire.node.tcpros_streams import NodeLimits
from roswire.node.topics import Received
from roswire.tcpros import Body
from roswire.uris import node_uri, parse_node_uri

A = TypeVar("A")
_NAME = "/rosrv_standing"
_LOOK_SECONDS = 0.2
_MAX_OF_LOOK = 20  # messages
_COUNTED_SECONDS = 1.5  # after which the appliance's numbers have what passed
_MAX = 16  # topics of each kind
WITHIN = 120.0
"""The seconds that a verb waits unless the operator says otherwise."""
WhenStanding = Annotated[
    bool,
    typer.Option(
        "--when-standing",
        help="On the appliance's machine: change nothing until the robot stands still, by its velocity commands and its"
        " odometry",
    ),
]


def _seconds(given: str | float) -> float:
    """Return the seconds of --within; typer also converts the default."""
    return given if isinstance(given, float) else bounded_span("--within", given, "1s", "1h")


def longest_wait(end: str) -> object:
    """Return the option --within, in seconds, with the default `WITHIN`."""
    return typer.Option(
        "--within",
        parser=_seconds,
        metavar="DURATION",
        show_default=False,
        help=f"The longest wait {end}, 1s to 1h (default: 2m)",
    )


Within = Annotated[float, longest_wait("of --when-standing")]


class NotStandingError(Exception):
    """The robot did not stop before the end of the wait, or its topics cannot be heard; the message says why."""


def stand_or_exit(appliance: Appliance, within: float, verb: str) -> None:
    """Wait until this machine's robot stands still, and print the evidence. Exit with status 1 if it does not."""
    if not isinstance(appliance.way, AdminSocket):
        raise usage_error(
            "--when-standing listens to the robot's topics: run it on the appliance's machine", verb
        )
    try:
        said = asyncio.run(wait_until_robot_stands(appliance, appliance.way.state, within))
    except NotStandingError as error:
        raise refusal([printable(f"{verb}: {error}. Nothing was changed")]) from None
    if not appliance.as_json:
        say(printable(said))


def _master_of(state: Path) -> tuple[str, str]:
    """Return the URI of RVMaster, and an address of this machine that the robot's nodes reach."""
    from appliance.configuration.settings import load_resolved  # noqa: PLC0415  pydantic, in each verb with --when-standing

    try:
        settings = load_resolved(state / "run" / "config.json")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise NotStandingError(
            f"no appliance has run in {state} ({why}): name its state directory with --state"
        ) from None
    host, port = settings.listen_address
    if settings.isolation == "netns" or ip_address(host).is_unspecified:
        host = "127.0.0.1"
    return node_uri(host, port), link_address() or host


def _ask(appliance: Appliance, request: AdminRequest[A]) -> A:
    """Return the appliance's answer. Raises `NotStandingError`."""
    try:
        answer = appliance.ask(request)
    except NotRunningError as error:
        raise NotStandingError(str(error)) from None
    if not answer.ok:
        raise NotStandingError(answer.error)
    return answer.unwrap()


def _graph_of(graph: Graph) -> MasterGraph:
    ends = [(PUBLICATION, topic.name, one.node) for topic in graph.topics for one in topic.publishers]
    ends += [(SUBSCRIPTION, topic.name, name) for topic in graph.topics for name in topic.subscribers]
    return MasterGraph(frozenset(ends), {topic.name: topic.type for topic in graph.topics})


def _robot_nodes(graph: Graph, policy: PolicyInForce) -> frozenset[str]:
    """Return the nodes of the robot's machine: those of the hosts that the policy calls `robot`.

    Without one, as beside an appliance in a container, all nodes count.
    """
    networks = [ip_network(text, strict=False) for text in (*policy.robot, *policy.own)]

    def is_robot(host: str) -> bool:
        address = ip_address(host)
        return address.is_loopback or any(address in network for network in networks)

    here = frozenset(node.name for node in graph.nodes if is_robot(node.host))
    return here or frozenset(node.name for node in graph.nodes)


def _nodes_here(graph: MasterGraph) -> frozenset[str]:
    """Return the nodes of this machine, by the addresses that they registered at their master."""
    hosts: dict[str, str] = {}
    for name, text in graph.nodes.items():
        with suppress(RosError):
            hosts[name] = parse_node_uri(text).host
    names = {host for host in hosts.values() if not _is_address(host)}
    found = addresses_of(names)
    return frozenset(
        name for name, host in hosts.items() if any(is_here(one) for one in found.get(host, [host]))
    )


def _is_address(text: str) -> bool:
    with suppress(ValueError):
        return bool(ip_address(text))
    return False


def link_address() -> str:
    """Return the machine's address on the appliance's link; empty while no appliance with such a link runs."""
    held = addresses_by_interface(Namespace.own()).get(LINK, [])
    return next((text.partition("/")[0] for text in held if "." in text), "")


async def wait_until_standing(master: str, longest: float, source: str = "127.0.0.1") -> str:
    """Wait until the robot at its own master stands; return the signs of it, and what is not seen.

    Raises `NotStandingError`, at the latest after `longest` s.
    `source` is an address of this machine that the robot's nodes reach.
    """
    try:
        graph = await MasterReader(parse_node_uri(master)).read()
    except (MasterReadError, RosError) as error:
        raise NotStandingError(f"the topics at {master} cannot be read: {error}") from None
    own = await asyncio.to_thread(_nodes_here, graph)
    try:
        return await _wait(graph, motion_topics(graph, own), longest, _by_node(master, source))
    except RosError as error:
        raise NotStandingError(f"the topics cannot be heard: {error}") from None


async def wait_until_robot_stands(appliance: Appliance, state: Path, longest: float) -> str:
    """Do the same as `wait_until_standing` for the robot of the appliance on this machine.

    Where the policy does not let this machine subscribe, as in a container, the appliance shows the messages.
    """
    master, source = _master_of(state)
    found = _ask(appliance, GraphWanted())
    graph = _graph_of(found)
    topics = motion_topics(graph, _robot_nodes(found, _ask(appliance, PolicyWanted())))
    try:
        return await _wait(graph, topics, longest, _by_node(master, source))
    except RosError:
        return await _wait(graph, topics, longest, _by_looks(appliance, found))


Unheard = Callable[[], Awaitable[str]]
"""Returns the command topics of which a message passed unheard, and no later one was heard."""

Hearing = Callable[[StandingJudge, Mapping[str, str]], AbstractAsyncContextManager[Unheard]]
"""Tells a judge the speeds of topics with these types, until the end of the context."""


async def _wait(graph: MasterGraph, topics: MotionTopics, longest: float, hearing: Hearing) -> str:
    for found in (topics.commands, topics.odometry):
        if len(found) > _MAX:
            raise NotStandingError(
                f"a base has {counted(len(found), 'topic')}, more than can be heard ({_MAX})"
            )
    judge, until = StandingJudge(topics), clock.now() + longest
    types = {topic: graph.types[topic] for topic in sorted({*topics.commands, *topics.odometry})}
    async with hearing(judge, types) as unheard:
        while why := judge.why_not(clock.now()) or await unheard():
            if clock.now() > until or judge.deaf or not topics.commands:
                raise NotStandingError(f"the robot is not known to stand still: {why}")
            await asyncio.sleep(_LOOK_SECONDS)
    seen = f" and {counted(len(topics.odometry), 'odometry topic')}" if topics.odometry else ""
    stands = f"the robot stands still: zero for {judge.seconds:g} s on {', '.join(judge.commanded)}{seen}"
    return f"{stands}. Not seen: {unseen(graph, topics, judge.silent)}"


def _by_node(master: str, source: str) -> Hearing:
    """Hear as a node of the graph. The context raises `RosError` where a topic cannot be heard."""

    async def nothing() -> str:
        return ""

    @asynccontextmanager
    async def hear(judge: StandingJudge, types: Mapping[str, str]) -> AsyncIterator[Unheard]:
        network = SourceNetwork(source)
        node = RosNode(_NAME, master, network, limits=NodeLimits(), shut_down=lambda _reason: None)
        try:
            await node.start()
            for topic, kind in types.items():
                await node.subscribe(topic, _listener(judge, topic, kind))
            yield nothing
        finally:
            await node.close()

    return hear


class _SeenMessage(msgspec.Struct):
    fields: dict[str, object]
    why: str


class _Seen(msgspec.Struct):
    """The part that is used of an answer to a look."""

    messages: list[_SeenMessage]


def _by_looks(appliance: Appliance, began: Graph) -> Hearing:
    """Hear by looks of the appliance, one after the other for each topic. Between two looks, a message may pass.

    The appliance counts the messages of each publisher, and reports each second: a command that passed unheard, and was
    followed by none that was heard, is found by the numbers.
    """
    look = request_named("topic look")
    assert look is not None  # noqa: S101  the feature `topics` has it
    before = _messages(began)

    @asynccontextmanager
    async def hear(judge: StandingJudge, types: Mapping[str, str]) -> AsyncIterator[Unheard]:
        heard, last = Counter[str](), dict[str, float]()
        loop, over = asyncio.get_running_loop(), threading.Event()

        def follow(topic: str, kind: str) -> None:
            try:
                while not over.is_set():
                    order = {"verb": "topic look", "topic": topic, "messages": _MAX_OF_LOOK, "seconds": 1.0}
                    seen = msgspec.convert(
                        _ask(appliance, msgspec.convert(order, look)), _Seen, from_attributes=True
                    )
                    loop.call_soon_threadsafe(note, topic, kind, seen)
            except NotStandingError as error:
                loop.call_soon_threadsafe(setattr, judge, "deaf", f"{topic} cannot be heard: {error}")

        def note(topic: str, kind: str, seen: _Seen) -> None:
            for message in seen.messages:
                heard[topic] += 1
                last[topic] = clock.now()
                judge.hear(topic, math.inf if message.why else speed_of(kind, message.fields), clock.now())

        async def unheard() -> str:
            await asyncio.sleep(_COUNTED_SECONDS)
            now = _messages(await asyncio.to_thread(_ask, appliance, GraphWanted()))
            quiet = [
                topic
                for topic in judge.topics.commands
                if clock.now() - last.get(topic, -math.inf) > STILL_SECONDS
            ]
            missed = [topic for topic in sorted(quiet) if now[topic] - before[topic] > heard[topic]]
            return f"a command on {some(missed)} was not heard" if missed else ""

        with ThreadPoolExecutor(max(1, len(types)), "looks") as threads:
            for row in types.items():
                threads.submit(follow, *row)
            try:
                yield unheard
            finally:
                over.set()

    return hear


def _messages(graph: Graph) -> Counter[str]:
    return Counter({topic.name: sum(one.messages for one in topic.publishers) for topic in graph.topics})


def _listener(judge: StandingJudge, topic: str, kind: str) -> Received:
    def heard(data: Body, _header: Mapping[str, str]) -> None:
        judge.hear(topic, speed_in(kind, bytes(data)), clock.now())

    return heard
