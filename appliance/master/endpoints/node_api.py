"""Call nodes at their peer address.

When a node is killed, the next node may get its port. An order to shut down an earlier incarnation is therefore not
sent to the address of a live node. (Two live nodes may share an address: some programs serve several names by one API.)

Every answer of a node is a code, a text, and a number or a protocol. Answers have a far smaller limit than requests,
because thousands of nodes may answer at once, and each may be compromised.
"""

from appliance.master.graph.registry import Incarnation, Life, Registry
from appliance.rpc.xmlrpc_client import RefusedError, XmlRpcClient
from roswire.uris import node_uri
from roswire.xmlrpc import Value, XmlRpcLimits

ANSWER = XmlRpcLimits(body=16 << 10, elements=256, depth=4, string=16 << 10, parts=0)


class NodeApiClient:
    """The client for calls to nodes; `timeout` is in seconds per call."""

    def __init__(self, registry: Registry, *, timeout: float) -> None:
        self._registry = registry
        self._timeout = timeout

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """Return a client for the node's address, which another process may have now."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=ANSWER)

    async def call(self, incarnation: Incarnation, method: str, *params: Value) -> Value:
        """Call a node. Raises `CallFailedError`; `RefusedError` also for a shutdown that another node would get."""
        if method == "shutdown" and incarnation.life is not Life.LIVE:
            uri = incarnation.call_uri
            there = next((other for other in self._registry.live() if other.call_uri == uri), None)
            if there is not None:
                where = node_uri(uri.host, uri.port, uri.path)
                raise RefusedError(f"{where} was not called: {there.name} has that address now")
        return await self.client(incarnation).call(method, *params)
