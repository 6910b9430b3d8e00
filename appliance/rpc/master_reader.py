"""Read the graph of a ROS master that is not the appliance's own, with calls that change nothing.

The answers may come from any program that reached the master, so each call has a time and a size, each list a most
number, and the whole reading a time. Names are looked up in the master's order, that of the first registrations: those
that a host adds later come last, and are left out if the time is over. Names and URIs stay as they are: `rosmaster`
ends a node whose URI returns in another spelling. They must be checked before use, like the parameters of a call.
"""

import asyncio
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from appliance.base import clock
from appliance.rpc.xmlrpc_client import CallFailedError, XmlRpcClient
from roswire.uris import NodeUri
from roswire.xmlrpc import Value, XmlRpcLimits

READ_LIMITS = XmlRpcLimits(body=16 << 20)
CALLER = "/rosrv"
_AT_ONCE = 8
_LOOKUPS = 0.6  # of the time of a reading, after which no further address is asked for
_LONGEST = 1024  # characters of a name or URI

Entry = tuple[str, str, str]
"""A registration: `publication`, `subscription` or `service`; its topic or service; the name of its node."""

MasterCall = tuple[str, str, tuple[Value, ...]]
"""A call: the method, the name of the caller, and the parameters after it."""

PUBLICATION, SERVICE, SUBSCRIPTION = "publication", "service", "subscription"
ORDER = (PUBLICATION, SERVICE, SUBSCRIPTION)
"""The order in which registrations are made: a subscriber with a list of one of two publishers drops the other."""


class MasterReadError(Exception):
    """The master does not answer as a ROS master, or not in time."""


@dataclass(frozen=True)
class MasterGraph:
    """The graph of a master. `services` has the URIs of services, `nodes` those of nodes, as registered."""

    entries: frozenset[Entry] = frozenset()
    types: dict[str, str] = field(default_factory=dict)
    nodes: dict[str, str] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    def in_order(self) -> Iterator[Entry]:
        for kind in ORDER:
            yield from sorted(entry for entry in self.entries if entry[0] == kind)

    @property
    def registered(self) -> tuple[object, ...]:
        """The parts that are equal in two readings of an unchanged graph."""
        return self.entries, self.nodes, self.services


class MasterReader:
    """Reads one master. `seconds` bounds a call, `whole` a reading, `rows` each list of names."""

    def __init__(
        self, uri: NodeUri, *, seconds: float = 3.0, whole: float = 30.0, rows: int = 20_000
    ) -> None:
        self.uri = uri
        self._seconds, self._whole, self._rows = seconds, whole, rows

    async def read(self) -> MasterGraph:
        """Return the graph. Raises `MasterReadError`."""
        client = self._client(_AT_ONCE)
        try:
            async with asyncio.timeout(self._whole):
                return await self._read(client)
        except TimeoutError:
            raise MasterReadError(f"reading the master takes longer than {self._whole:g} s") from None
        except CallFailedError as error:
            raise MasterReadError(str(error)) from None
        finally:
            client.close()

    async def parameters(self) -> dict[str, Value]:
        """Return all parameters. Raises `MasterReadError`."""
        try:
            tree = await self.ask("getParam", "/")
        except CallFailedError as error:
            raise MasterReadError(str(error)) from None
        if not isinstance(tree, dict):
            raise MasterReadError("the master's parameters are not a namespace")
        return tree

    async def ask(self, method: str, *params: Value, caller: str = CALLER) -> Value:
        """Return the value of an answer. Raises `CallFailedError`."""
        client = self._client(0)
        return value_of(method, await client.call(method, caller, *params))

    async def ask_all(self, calls: Sequence[MasterCall]) -> "list[Value | CallFailedError]":
        """Make calls in order: the method, the name of the caller, the parameters. A failure does not end the rest."""
        client = self._client(1)
        answers: list[Value | CallFailedError] = []
        try:
            for method, caller, params in calls:
                try:
                    answers.append(value_of(method, await client.call(method, caller, *params)))
                except CallFailedError as error:
                    answers.append(error)
        finally:
            client.close()
        return answers

    def _client(self, pool: int) -> XmlRpcClient:
        return XmlRpcClient(self.uri, timeout=self._seconds, pool=pool, limits=READ_LIMITS)

    async def _read(self, client: XmlRpcClient) -> MasterGraph:
        began = clock.now()
        state = value_of("getSystemState", await client.call("getSystemState", CALLER))
        if not (isinstance(state, list) and len(state) == len(ORDER)):
            raise CallFailedError("getSystemState was not answered with three lists")
        left_out: list[str] = []
        entries: dict[Entry, None] = {}
        for kind, rows in zip((PUBLICATION, SUBSCRIPTION, SERVICE), state, strict=True):
            found = list(_entries(kind, rows))
            if len(found) > self._rows:
                left_out.append(f"{len(found) - self._rows} of {len(found)} {kind}s")
            entries |= dict.fromkeys(found[: self._rows])
        types = value_of("getTopicTypes", await client.call("getTopicTypes", CALLER))
        until = began + _LOOKUPS * self._whole
        names = dict.fromkeys(entry[2] for entry in entries)
        nodes = await self._addresses(client, "lookupNode", names, until, left_out)
        names = dict.fromkeys(entry[1] for entry in entries if entry[0] == SERVICE)
        services = await self._addresses(client, "lookupService", names, until, left_out)
        return MasterGraph(frozenset(entries), dict(_pairs(types)), nodes, services, tuple(left_out))

    async def _addresses(
        self, client: XmlRpcClient, method: str, names: Iterable[str], until: float, left_out: list[str]
    ) -> dict[str, str]:
        turns = asyncio.Semaphore(_AT_ONCE)
        late: list[str] = []

        async def one(name: str) -> tuple[str, str]:
            async with turns:
                if clock.now() > until:
                    late.append(name)
                    return name, ""
                answer = await client.call(method, CALLER, name)
            match answer:
                case [1, _, str(uri)] if len(uri) <= _LONGEST:
                    return name, uri
            return name, ""  # it has ended since

        found = await asyncio.gather(*map(one, names))
        if late:
            left_out.append(f"the addresses of {len(late)} of {len(found)} names ({method})")
        return {name: uri for name, uri in found if uri}


def value_of(method: str, answer: Value) -> Value:
    """Return the value of an answer `[1, text, value]`. Raises `CallFailedError`."""
    match answer:
        case [1, _, value]:
            return value
        case [int(), str(text), _]:
            raise CallFailedError(f"{method} was answered with: {printable(text)}")
    raise CallFailedError(f"{method} was not answered with [code, text, value]")


def printable(text: str) -> str:
    return "".join(char if char.isprintable() else "?" for char in text[:256])


def _entries(kind: str, rows: Value) -> Iterator[Entry]:
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [str(resource), list(names)] if len(resource) <= _LONGEST:
                for name in names:
                    if isinstance(name, str) and len(name) <= _LONGEST:
                        yield kind, resource, name


def _pairs(rows: Value) -> Iterator[tuple[str, str]]:
    for row in rows if isinstance(rows, list) else ():
        match row:
            case [str(topic), str(kind)] if len(topic) <= _LONGEST and len(kind) <= _LONGEST:
                yield topic, kind
