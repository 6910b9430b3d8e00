"""Read a graph from its ROS master and its nodes, with calls that register and change nothing.

The answers come from programs that are not checked: each call has a time and a size, each list a most number, and the
whole survey a time. The inventory names the parts that a limit leaves out. Any host may have registered names, so each
host has a share of the time, and this machine's own nodes are asked first. Only hosts where a node answered are scanned
for well-known ports: a registered URI makes no other host a target.
"""

import asyncio
import ipaddress
import itertools
import re
import socket
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple, TypeGuard

from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.host_names import addresses_of
from appliance.rpc.graph_inventory import (
    APPLIANCE,
    LISTENERS,
    MASTER_PORT,
    GraphInventory,
    NodeConnection,
    OpenPort,
    SurveyedNode,
    SurveyedService,
    SurveyedTopic,
)
from appliance.rpc.host_shares import HostShare, serve_by_host
from appliance.rpc.xmlrpc_client import CallFailedError, XmlRpcClient
from roswire.errors import InvalidUriError
from roswire.uris import NodeUri, parse_node_uri
from roswire.xmlrpc import Value, XmlRpcLimits

_CALLER = "/rosrv_survey"
_LIMITS = XmlRpcLimits(body=16 << 20)
_LONGEST = 256  # characters of a name or text
_LONGEST_DENIAL = 2048
_RECORD = re.compile(r" \[[0-9a-f]{20}\]$")  # the end of a denial
_HOST_SHARE = 0.25  # of the whole time
_PORT_SECONDS = 1.0  # of a well-known port


class SurveyLimits(NamedTuple):
    """The bounds of a survey; times are in seconds."""

    call: float = 3.0
    whole: float = 60.0
    at_once: int = 16
    """Calls of the master, and nodes of one host, at the same time."""
    rows: int = 20_000
    """Nodes, topics, services or parameters, each; connections of a node."""
    sample: float = 1.0
    """How long messages are counted."""


class SurveyError(Exception):
    """The master does not answer as a ROS master; the message says what to do."""


async def survey(uri: str, limits: SurveyLimits) -> GraphInventory:
    """Return the inventory of the graph of the master at `uri`. Raises `SurveyError`."""
    try:
        master = parse_node_uri(uri)
    except InvalidUriError as error:
        raise SurveyError(f"{error}: give it like --master http://robot:11311") from None
    return await _Survey(master, uri, limits).read()


class _DeniedError(CallFailedError):
    """An appliance answers, and its policy denies the call."""


class _Asked(NamedTuple):
    """The answers of a node; `problem` is why it could not be asked."""

    problem: str = "it did not answer in the time of its host"
    pid: int | None = None
    connections: tuple[NodeConnection, ...] = ()


class _Survey:
    def __init__(self, master: NodeUri, uri: str, limits: SurveyLimits) -> None:
        self._master, self._uri, self._limits = master, uri, limits
        self._began = clock.now()
        self._calls = 0
        self._left_out: list[str] = []
        self._turns = asyncio.Semaphore(limits.at_once)
        self._addresses: dict[str, str] = {}

    async def read(self) -> GraphInventory:
        master = XmlRpcClient(
            self._master, timeout=self._limits.call, pool=self._limits.at_once, limits=_LIMITS
        )
        try:
            state = await self._ask(master, "getSystemState")
            protected = await self._is_appliance(master)
            types = dict(_pairs(await self._ask(master, "getTopicTypes")))
            parameters = _names(await self._ask(master, "getParamNames"))
            publishers, subscribers, services = (
                {_text(row[0]): _names(row[1]) for row in _rows(part, 2)} for part in _parts(state, 3)
            )
            names = self._cut(
                "nodes",
                sorted(
                    {
                        node
                        for part in (publishers, subscribers, services)
                        for row in part.values()
                        for node in row
                    }
                ),
            )
            nodes, rates = await self._nodes(master, names)
            found = await self._services(master, self._cut("services", sorted(services)), services)
        except _DeniedError as error:
            raise SurveyError(
                f"{error}. An appliance answers as the master: its policy decides what this host may read"
            ) from None
        except CallFailedError as error:
            raise SurveyError(f"{error}. Is {self._uri} the robot's ROS_MASTER_URI?") from None
        finally:
            master.close()
        topics = tuple(
            SurveyedTopic(
                name,
                types.get(name, "*"),
                publishers.get(name, ()),
                subscribers.get(name, ()),
                rates.get(name),
            )
            for name in self._cut("topics", sorted({*publishers, *subscribers}))
        )
        await self._resolve([self._master.host])
        host = self._addresses[self._master.host]
        hosts = {node.host for node in nodes}
        answering = {node.host for node in nodes if not node.problem}
        return GraphInventory(
            self._uri, host, nodes, topics, found, tuple(self._cut("parameters", sorted(parameters))),
            await self._listeners(host, answering, protected=protected), self._calls,
            round(clock.now() - self._began, 2), tuple(self._left_out),
            tuple(sorted(filter(is_here, {*hosts} - {""}))) if is_here(host) else (),
            protected,
        )  # fmt: skip

    def _cut(self, what: str, names: Sequence[str]) -> Sequence[str]:
        if len(names) > self._limits.rows:
            self._left_out.append(f"{len(names) - self._limits.rows} of {len(names)} {what}")
        return names[: self._limits.rows]

    async def _counts(self, client: XmlRpcClient) -> Value:
        """Return the answer to `getBusStats`, which roscpp gives without a code and a text."""
        answer = await self._answer(client, "getBusStats")
        return answer[2] if isinstance(answer, list) and len(answer) == 3 else answer

    async def _ask(self, client: XmlRpcClient, method: str, *parameters: Value) -> Value:
        """Return the value of an answer. Raises `CallFailedError`."""
        answer = await self._answer(client, method, *parameters)
        if not (isinstance(answer, list) and len(answer) == 3 and answer[0] == 1):
            if _is_denial(answer):
                raise _DeniedError(f"{method} was denied: {_text(answer[1], _LONGEST_DENIAL)}")
            said = _text(answer[1]) if isinstance(answer, list) and len(answer) > 1 else "not a ROS answer"
            raise CallFailedError(f"{method} was answered with: {said}")
        return answer[2]

    async def _answer(self, client: XmlRpcClient, method: str, *parameters: Value) -> Value:
        if clock.now() - self._began > self._limits.whole:
            raise CallFailedError(f"the survey takes longer than {self._limits.whole:g} s")
        self._calls += 1
        return await client.call(method, _CALLER, *parameters)

    async def _is_appliance(self, master: XmlRpcClient) -> bool:
        try:
            ports = await self._ask(master, "getRVState")
        except CallFailedError as error:
            return isinstance(error, _DeniedError)
        return isinstance(ports, list) and len(ports) == 3

    async def _nodes(
        self, master: XmlRpcClient, names: Sequence[str]
    ) -> tuple[tuple[SurveyedNode, ...], dict[str, float]]:
        counts: list[dict[str, tuple[float, int]]] = []
        listed = await asyncio.gather(*(self._listed(master, name) for name in names))
        await self._resolve(place.host for _node, place in listed if place is not None)
        here = {host for host in {*self._addresses.values()} if host and is_here(host)}
        asked: dict[NodeUri, str] = {}
        for _node, place in listed:
            if place is not None and (host := self._addresses[place.host]):
                asked[place] = f"port {place.port}" if host in here else host
        own_first = dict(sorted(asked.items(), key=lambda row: not row[1].startswith("port ")))
        left = max(0.0, self._limits.whole - (clock.now() - self._began))
        results = await serve_by_host(
            own_first, lambda place: self._node(place, counts),
            HostShare(min(left, _HOST_SHARE * self._limits.whole), left, self._limits.at_once),
        )  # fmt: skip
        nodes, late = list[SurveyedNode](), 0
        for node, place in listed:
            host = "" if place is None else self._addresses[place.host]
            if place is None or not host:
                nodes.append(node)
                continue
            late += place not in results
            said = results.get(place, _Asked())
            nodes.append(SurveyedNode(node.name, node.uri, host, said.pid, said.problem, said.connections))
        if late:
            self._left_out.append(
                f"{late} of {counted(len(nodes), 'node')}: the time of their hosts was over"
            )
        rates: dict[str, float] = {}
        for sample in counts:
            for topic, (rate, _number) in sample.items():
                rates[topic] = round(rates.get(topic, 0) + rate, 1)
        return tuple(nodes), rates

    async def _listed(self, master: XmlRpcClient, name: str) -> tuple[SurveyedNode, NodeUri | None]:
        """Return a node as the master lists it, and its place; without a valid one, None and the problem."""
        uri = ""
        try:
            async with self._turns:
                uri = _text(await self._ask(master, "lookupNode", name))
            node_uri = parse_node_uri(uri)
        except (CallFailedError, InvalidUriError) as error:
            return SurveyedNode(name, uri, problem=str(error)), None
        return SurveyedNode(name, uri, problem=f"{node_uri.host} is not known on this machine"), node_uri

    async def _node(self, uri: NodeUri, counts: list[dict[str, tuple[float, int]]]) -> _Asked:
        client = XmlRpcClient(
            replace(uri, host=self._addresses[uri.host]), timeout=self._limits.call, limits=_LIMITS
        )
        try:
            pid = await self._ask(client, "getPid")
            bus = _rows(await self._ask(client, "getBusInfo"), 5)[: self._limits.rows]
            before, began = _sent(await self._counts(client)), clock.now()
            if before:
                await asyncio.sleep(self._limits.sample)
                after = _sent(await self._counts(client))
                seconds = max(self._limits.sample, clock.now() - began)
                counts.append({
                    topic: ((after[topic] - sent) / seconds, after[topic])
                    for topic, sent in before.items() if after.get(topic, 0) >= sent
                })  # fmt: skip
        except CallFailedError as error:
            return _Asked(str(error))
        return _Asked("", pid if isinstance(pid, int) else None, tuple(map(_connection, bus)))

    async def _services(
        self, master: XmlRpcClient, names: Iterable[str], providers: dict[str, tuple[str, ...]]
    ) -> tuple[SurveyedService, ...]:
        async def one(name: str) -> SurveyedService:
            uri = ""
            with suppress(CallFailedError):  # it has ended since
                async with self._turns:
                    uri = _text(await self._ask(master, "lookupService", name))
            return SurveyedService(name, providers[name], uri)

        return tuple(await asyncio.gather(*map(one, names)))

    async def _resolve(self, hosts: Iterable[str]) -> None:
        """Note an address of each host; empty for a name that is not known."""
        names: list[str] = []
        for host in hosts:
            try:
                self._addresses[host] = str(ipaddress.ip_address(host))
            except ValueError:
                names.append(host)
        new = [name for name in names if name not in self._addresses]
        if new:
            found = await asyncio.to_thread(addresses_of, new)
            self._addresses |= {
                name: next(iter(sorted(found[name], key=lambda one: ":" in one)), "") for name in new
            }

    async def _listeners(self, master: str, hosts: set[str], *, protected: bool) -> tuple[OpenPort, ...]:
        """Connect to well-known ports of these hosts, and close at once."""
        place = master, self._master.port
        own = OpenPort(*place, APPLIANCE if protected else LISTENERS[MASTER_PORT])

        async def one(row: tuple[str, int]) -> OpenPort | None:
            host, port = row
            try:
                async with asyncio.timeout(min(_PORT_SECONDS, self._limits.call)):
                    _reader, writer = await asyncio.open_connection(host, port)
            except (OSError, TimeoutError):
                return None
            writer.close()
            return OpenPort(host, port, LISTENERS[port]) if row != place else own

        pairs = itertools.product(sorted({master, *hosts} - {""}), LISTENERS)
        seconds = 2 * _PORT_SECONDS
        results = await serve_by_host({row: row[0] for row in pairs}, one, HostShare(seconds, seconds))
        return tuple(dict.fromkeys([own, *filter(None, results.values())]))


def is_here(address: str) -> bool:
    """Return whether an address belongs to this machine: packets to it would also have it as source."""
    with suppress(OSError, ValueError):
        if ipaddress.ip_address(address).is_loopback:
            return True
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((address, MASTER_PORT))  # sends nothing
            return str(probe.getsockname()[0]) == address
    return False


def _is_denial(answer: Value) -> TypeGuard[list[Value]]:
    """Return whether an answer names its audit record, as only an appliance's does."""
    return (
        isinstance(answer, list) and len(answer) == 3 and isinstance(answer[1], str)
        and _RECORD.search(answer[1]) is not None
    )  # fmt: skip


def _text(value: object, longest: int = _LONGEST) -> str:
    """Return a text of a node, without control characters, or its type in brackets."""
    if not isinstance(value, str):
        return f"<{type(value).__name__}>"
    return "".join(char if char.isprintable() else "?" for char in value[:longest])


def _connection(row: list[Value]) -> NodeConnection:
    peer, direction, transport, topic = (_text(cell) for cell in row[1:5])
    return NodeConnection(topic, peer, direction, transport, bool(row[5]) if len(row) > 5 else True)


def _parts(value: Value, number: int) -> list[Value]:
    if not (isinstance(value, list) and len(value) == number):
        raise CallFailedError(f"an answer does not have the length {number}")
    return value


def _rows(value: Value, least: int) -> list[list[Value]]:
    if not isinstance(value, list):
        raise CallFailedError("an answer is not a list")
    return [row for row in value if isinstance(row, list) and len(row) >= least]


def _pairs(value: Value) -> list[tuple[str, str]]:
    return [(_text(row[0]), _text(row[1])) for row in _rows(value, 2)]


def _names(value: Value) -> tuple[str, ...]:
    return tuple(_text(name) for name in value if isinstance(name, str)) if isinstance(value, list) else ()


def _sent(value: Value) -> dict[str, int]:
    """Return the messages sent so far for each topic, by `getBusStats`.

    A row of rospy is `[topic, bytes, [[id, bytes, messages, …], …]]`; one of roscpp is
    `[topic, [[id, bytes, bytes of messages, messages, …], …]]`.
    """
    publications = value[0] if isinstance(value, list) and value else None
    sent: dict[str, int] = {}
    for row in publications if isinstance(publications, list) else ():
        if not (isinstance(row, list) and len(row) > 1 and isinstance(row[-1], list)):
            continue
        column = 3 if len(row) == 2 else 2
        numbers = [link[column] for link in row[-1] if isinstance(link, list) and len(link) > column]
        if counts := [number for number in numbers if isinstance(number, int)]:
            sent[_text(row[0])] = max(counts)
    return sent
