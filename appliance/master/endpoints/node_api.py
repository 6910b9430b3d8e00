"""Call nodes at their peer address.

After a node was killed, another node may get its port. So a shutdown of an earlier incarnation is not sent to the
address of a live node, and a call that probes or ends a node opens a new connection. Several live nodes may share an
address, because some programs serve several names with one API.

The size limit for answers is small, because thousands of nodes may answer at once, and each may be compromised.
"""

import asyncio

from appliance.master.graph.registry import Incarnation, Life, Registry
from appliance.rpc.xmlrpc_client import RefusedError, XmlRpcClient
from roswire.uris import NodeUri, node_uri
from roswire.xmlrpc import Value, XmlRpcLimits

ANSWER = XmlRpcLimits(body=16 << 10, elements=256, depth=4, string=16 << 10, parts=0)

_REUSES = frozenset({"requestTopic", "publisherUpdate", "paramUpdate"})  # a node may get each of these twice
_KEPT_SECONDS = 1.0  # between two rounds that close connections
_MOST_KEPT = 256  # addresses, each with one connection


class NodeApiClient:
    """Calls nodes; `timeout` is in seconds per call."""

    def __init__(self, registry: Registry, *, timeout: float) -> None:
        self._registry = registry
        self._timeout = timeout
        self._used: dict[
            NodeUri, XmlRpcClient
        ] = {}  # the clients with a connection that was used in this round
        self._unused: dict[NodeUri, XmlRpcClient] = {}  # in the round before, and not in this one
        self._round: asyncio.TimerHandle | None = None

    def client(self, incarnation: Incarnation, *, pool: int = 0) -> XmlRpcClient:
        """Return a client for the node's address, which another process may use now."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, pool=pool, limits=ANSWER)

    async def call(self, incarnation: Incarnation, method: str, *params: Value) -> Value:
        """Call a node. Raises `CallFailedError`; `RefusedError` for a shutdown if another node has the address."""
        if method == "shutdown" and incarnation.life is not Life.LIVE:
            uri = incarnation.call_uri
            there = next((other for other in self._registry.live() if other.call_uri == uri), None)
            if there is not None:
                where = node_uri(uri.host, uri.port, uri.path)
                raise RefusedError(f"{where} was not called: {there.name} has that address now")
        client = self._kept(incarnation) if method in _REUSES else self.client(incarnation)
        return await client.call(method, *params)

    def _kept(self, incarnation: Incarnation) -> XmlRpcClient:
        """Return a client with a kept connection (at most `_MOST_KEPT`): a starting node gets ten calls in a second."""
        uri = incarnation.call_uri
        client = self._used.get(uri) or self._unused.pop(uri, None)
        if client is None:
            if len(self._used) + len(self._unused) >= _MOST_KEPT:
                return self.client(incarnation)
            client = self.client(incarnation, pool=1)
        self._used[uri] = client
        if self._round is None:
            self._round = asyncio.get_running_loop().call_later(_KEPT_SECONDS, self._end_round)
        return client

    def _end_round(self) -> None:
        for client in self._unused.values():
            client.close()
        self._used, self._unused = {}, self._used
        later = asyncio.get_running_loop().call_later
        self._round = later(_KEPT_SECONDS, self._end_round) if self._unused else None
