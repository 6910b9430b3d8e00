"""Calls of the appliance to nodes, at their peer address.

A call that is meant for one node never goes to an address that another live one has: when a node is killed, the next
may get its port, and would be told to shut down in its place, or answer for it. Of two that gave the same address that
one has it which registered last: a port is one program's.
"""

from appliance.master.graph.registry import Incarnation, Registry
from appliance.ros.uris import node_uri
from appliance.ros.xmlrpc import Limits, Value
from appliance.rpc.client import RefusedError, XmlRpcClient


class NodeApi:
    """Calls nodes; `timeout` is seconds for one call."""

    def __init__(self, registry: Registry, *, timeout: float, limits: Limits) -> None:
        self._registry = registry
        self._timeout = timeout
        self._limits = limits

    def client(self, incarnation: Incarnation) -> XmlRpcClient:
        """A client for the node's address, whoever is there."""
        return XmlRpcClient(incarnation.call_uri, timeout=self._timeout, limits=self._limits)

    async def call(self, incarnation: Incarnation, method: str, *params: Value) -> Value:
        """Call a node. Raises `CallFailedError`; `RefusedError` also where another node is at its address."""
        uri = incarnation.call_uri
        there = self._registry.at(uri)
        if there is not None and there is not incarnation:
            where = node_uri(uri.host, uri.port, uri.path)
            raise RefusedError(f"{where} was not called: {there.name} has that address now")
        return await self.client(incarnation).call(method, *params)
