"""Send subscribers their lists of publishers, and wait until they are connected to these.

roscpp ends a connection at once when the list lacks its publisher, and connects to a new one some tenths of a second
later. So at a change of masters a node first gets a list with both, and only afterwards the one that it shall keep.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Collection, Mapping

from appliance.base import clock
from appliance.features.adopt.places import NodeCaller
from appliance.master.graph.registry import Incarnation
from appliance.rpc.host_shares import HostShare, serve_by_host
from appliance.rpc.master_reader import PUBLICATION, MasterGraph
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import Value

_AT_ONCE_OF_HOST = 16
_CONNECT_SECONDS = 1.5  # as long, at most, a node hears twice
_STILL_SECONDS = 0.5
_LOSE_SECONDS, _LOSE_SHARE = 2.5, HostShare(host=3.0, whole=3.0)
_PAUSE_SECONDS = 0.02
_LONGEST = 200  # characters of URIs that a node says

Subscription = tuple[Incarnation, str]
NodeShare = Callable[[Incarnation], str]
"""Returns the share by which a node is called, see `NodePlace.share`."""


def lists_of(graph: MasterGraph) -> dict[str, list[str]]:
    """Return the URIs of the publishers of each topic."""
    lists: dict[str, list[str]] = {}
    for kind, topic, name in sorted(graph.entries):
        if kind == PUBLICATION and name in graph.nodes:
            lists.setdefault(topic, []).append(graph.nodes[name])
    return lists


async def send_lists(
    call: NodeCaller, seconds: float, share: NodeShare, *lists: Mapping[Subscription, list[str]]
) -> list[str]:
    """Send each subscriber its lists in this order; return the names of the nodes that did not take them in that time.

    A node of this machine that does not answer delays only itself, and another host only its own nodes.
    """
    failed: set[str] = set()

    async def tell(row: Subscription) -> None:
        node, topic = row
        for one in lists:
            if node.name in failed:
                return
            try:
                await call(node.call_uri, "publisherUpdate", topic, [*one[row]])
            except CallFailedError:
                failed.add(node.name)

    rows = {row: share(row[0]) for row in (lists[0] if lists else ())}
    told = await serve_by_host(rows, tell, HostShare(seconds, seconds, _AT_ONCE_OF_HOST))
    return sorted(failed.union(node.name for node, topic in rows if (node, topic) not in told))


async def until_least(number: Callable[[], Awaitable[int]]) -> None:
    """Wait until the number is 0, or does not fall any more."""
    least, last, still = math.inf, clock.now() + _CONNECT_SECONDS, math.inf
    while (now := await number()) and clock.now() < min(last, still):
        if now < least:
            least, still = now, clock.now() + _STILL_SECONDS
        await asyncio.sleep(_PAUSE_SECONDS)


async def until_connected(
    call: NodeCaller, wanted: dict[Subscription, set[str]]
) -> dict[Subscription, set[str]]:
    """Wait until nodes tell that they are connected; return what is missing, of nodes that answer."""

    async def look(node: Incarnation) -> None:
        try:
            connected = _inbound(await call(node.call_uri, "getBusInfo"))
        except CallFailedError:
            connected = None
        for row in [row for row in wanted if row[0] is node]:
            wanted[row] -= wanted[row] if connected is None else connected.get(row[1], set())
            if not wanted[row]:
                del wanted[row]

    async def number() -> int:
        looks = [asyncio.create_task(look(node)) for node in {node for node, _topic in wanted}]
        if looks:
            _done, late = await asyncio.wait(looks, timeout=_STILL_SECONDS)
            for one in late:
                one.cancel()
        return sum(map(len, wanted.values()))

    await until_least(number)
    return wanted


async def reconnect(
    call: NodeCaller,
    share: NodeShare,
    lists: Mapping[Subscription, Collection[str]],
    tell: Callable[[Subscription], Awaitable[object]],
) -> dict[str, str]:
    """Tell subscribers their lists, each once its connections to other publishers have ended.

    After a cut, a node still reads what its kernel had received, and lists the connection until then. roscpp lists it
    until a list lacks it. Return the subscriptions, by `NODE TOPIC`, that got a list although their connections were
    not known to have ended, with the reasons.
    """

    async def lose(row: Subscription) -> str:
        (node, topic), wanted = row, {*lists[row]}
        until, asked, why = clock.now() + _LOSE_SECONDS, False, ""
        while clock.now() < until:
            try:
                present = _inbound(await call(node.call_uri, "getBusInfo")).get(topic, set())
                if present <= wanted:
                    await tell(row)
                    return ""
                why = f"it is still connected to {', '.join(sorted(present - wanted))[:_LONGEST]}"
                if not asked:
                    kept: list[Value] = [*sorted(present & wanted)]
                    await call(node.call_uri, "publisherUpdate", topic, kept)
                    asked = True
            except CallFailedError as error:
                why = str(error)
            await asyncio.sleep(_PAUSE_SECONDS)
        return why

    lost = await serve_by_host({row: share(row[0]) for row in lists}, lose, _LOSE_SHARE)
    late = {row: why for row in lists if (why := lost.get(row, "not asked in time"))}
    for row in late:
        await tell(row)
    return {f"{node.name} {topic}": why for (node, topic), why in late.items()}


def _inbound(answer: Value) -> dict[str, set[str]]:
    """Return the URIs of the publishers to which a node says that it is connected, by topic."""
    found: dict[str, set[str]] = {}
    match answer:
        case [1, _, [*rows]]:
            for row in rows:
                match row:
                    case [_, str(uri), "i", _, str(topic), True, *_]:
                        found.setdefault(topic, set()).add(uri)
    return found
