"""Calls of the appliance to nodes, at their peer address.

When a node is killed, the next may get its port. What is meant for the dead must not end the living: an order to shut
down for an earlier life of a node is not sent where a live node is called. (Two live nodes may share an address: some
programs serve several names with one API.)

Whatever a node is asked, it answers a code, a text, and a number or one protocol. So an answer is bounded far below
what a node may ask for: thousands of nodes may answer at once, and each may have been taken over.
"""

from appliance.master.graph.registry import Incarnation, Life, Registry
from appliance.rpc.xmlrpc_client import RefusedError, XmlRpcClient
from roswire.uris import node_uri
from roswire.xmlrpc import Limits, Value

ANSWER = Limits(body=16 << 10, elements=256, depth=4, string=16 << 10, parts=0)


class NodeApi:
    """Calls nodes; `timeout` is seconds for one call."""

    def __init__(self, registry: Registry, *, timeout: float) -> None:
        self._registry = registry
        self._timeout = timeout

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """A client for the node's address, whoever is there."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=ANSWER)

    async def call(self, incarnation: Incarnation, method: str, *params: Value) -> Value:
        """Call a node. Raises `CallFailedError`; `RefusedError` also for what would shut down another in its place."""
        if method == "shutdown" and incarnation.life is not Life.LIVE:
            uri = incarnation.call_uri
            there = next((other for other in self._registry.live() if other.call_uri == uri), None)
            if there is not None:
                where = node_uri(uri.host, uri.port, uri.path)
                raise RefusedError(f"{where} was not called: {there.name} has that address now")
        return await self.client(incarnation).call(method, *params)
