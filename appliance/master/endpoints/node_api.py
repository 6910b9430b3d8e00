"""Call nodes at their peer address.

After a node was killed, another node may get its port. So an order to shut down an earlier incarnation is not sent to
the address of a live node. Several live nodes may share an address, because some programs serve several node names with
one API.

Each answer of a node is a code, a text, and a number or protocol. The size limit for answers is far smaller than for
requests, because thousands of nodes may answer at once, and each node may be compromised.
"""

from appliance.master.graph.registry import Incarnation, Life, Registry
from appliance.rpc.xmlrpc_client import RefusedError, XmlRpcClient
from roswire.uris import node_uri
from roswire.xmlrpc import Value, XmlRpcLimits

ANSWER = XmlRpcLimits(body=16 << 10, elements=256, depth=4, string=16 << 10, parts=0)


class NodeApiClient:
    """Call nodes; `timeout` is in seconds per call."""

    def __init__(self, registry: Registry, *, timeout: float) -> None:
        self._registry = registry
        self._timeout = timeout

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """Return a client for the node's address. Another process may use this address now."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=ANSWER)

    async def call(self, incarnation: Incarnation, method: str, *params: Value) -> Value:
        """Call a node. Raises `CallFailedError`.

        Raises `RefusedError` for a shutdown if another live node has the address.
        """
        if method == "shutdown" and incarnation.life is not Life.LIVE:
            uri = incarnation.call_uri
            there = next((other for other in self._registry.live() if other.call_uri == uri), None)
            if there is not None:
                where = node_uri(uri.host, uri.port, uri.path)
                raise RefusedError(f"{where} was not called: {there.name} has that address now")
        return await self.client(incarnation).call(method, *params)
