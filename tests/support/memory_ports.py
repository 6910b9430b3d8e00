"""Ports of nodes without sockets."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from appliance.master.endpoints.node_ports import NodePorts
from appliance.policy.policy import DEFAULT_PORTS, Policy


@dataclass(frozen=True)
class _Listening:
    host: str
    port: int

    def getsockname(self) -> tuple[str, int]:
        return self.host, self.port

    def fileno(self) -> int:
        return self.port

    def dup(self) -> "_Listening":
        return self

    def close(self) -> None: ...


@dataclass(frozen=True)
class _Face:
    close: Callable[[], None]
    go: asyncio.Event | None

    async def start(self) -> None:
        if self.go is not None:
            await self.go.wait()


def face(closed: Callable[[], None], go: asyncio.Event | None = None) -> Any:
    """Return the server of a proxy endpoint, which starts when `go` is set."""
    return _Face(closed, go)


def listening(host: str, port: int) -> Any:
    return _Listening(host, port)


def memory_ports(
    policy: Callable[[], Policy],
    ports: range = DEFAULT_PORTS,
    *,
    relays: int = 1,
    listen: Callable[[str, int], Any] = listening,
    drop: Callable[[str], None] = lambda _name: None,
) -> NodePorts:
    return NodePorts(
        "127.0.0.1", ports, keep=lambda *_: None, drop=drop, policy=policy, relays=relays, listen=listen
    )
