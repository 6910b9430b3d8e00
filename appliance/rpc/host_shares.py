"""Serve members that other hosts chose, such as the URIs of nodes: a host delays and crowds out only its own members.

1. Each host has turns and a time of its own, beside those of other hosts.
2. The order is that of the given members: callers put this machine's own first.
3. The whole has a time. A member that was not served by then is left out, so that callers can name it.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import NamedTuple, TypeVar

Member = TypeVar("Member")
Result = TypeVar("Result")


class HostShare(NamedTuple):
    """The bounds; times are in seconds."""

    host: float
    """The time of one host, from its first turn on."""
    whole: float
    host_at_once: int = 32
    at_once: int = 256


async def serve_by_host(
    members: Mapping[Member, str], work: Callable[[Member], Awaitable[Result]], share: HostShare
) -> dict[Member, Result]:
    """Return the results of the members that were served in time. `members` has the host of each.

    `work` raises no exception for what a member does.
    """
    hosts: dict[str, deque[Member]] = {}
    for member, host in members.items():
        hosts.setdefault(host, deque()).append(member)
    results: dict[Member, Result] = {}
    of_host = min(share.host_at_once, max(1, share.at_once // max(1, len(hosts))))
    turns = asyncio.Semaphore(share.at_once)

    async def serve(waiting: deque[Member], time: asyncio.Timeout) -> None:
        while waiting:
            async with turns:
                if time.when() is None:
                    time.reschedule(asyncio.get_running_loop().time() + share.host)
                if waiting:
                    member = waiting.popleft()
                    results[member] = await work(member)

    async def serve_host(waiting: deque[Member]) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(None) as time:
                await asyncio.gather(*(serve(waiting, time) for _ in range(min(of_host, len(waiting)))))

    with suppress(TimeoutError):
        async with asyncio.timeout(share.whole):
            await asyncio.gather(*map(serve_host, hosts.values()))
    return results
