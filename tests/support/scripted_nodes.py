"""Nodes without a process: their clients answer as a test says."""

from collections.abc import Awaitable, Callable
from typing import NamedTuple

from appliance.master.endpoints.delivery import ANSWER, NodeApiClient
from appliance.master.graph.registry import Incarnation, Registry
from appliance.rpc.xmlrpc_client import RefusedError, UnansweredError, XmlRpcClient
from roswire.xmlrpc import Value, XmlRpcLimits

Answer = Callable[[Incarnation, str, tuple[Value, ...]], Awaitable[Value]]


class UsedClient(NamedTuple):
    node: str
    pool: int
    limits: XmlRpcLimits


class ScriptedNodes(NodeApiClient):
    """Calls of nodes: `answer(node, method, parameters)` returns the answer, or raises `CallFailedError`.

    By default, a node answers with the number of its process, unless its name is in `gone` or `silent`.
    """

    def __init__(self, registry: Registry) -> None:
        super().__init__(registry, timeout=3.0)
        self.gone: set[str] = set()
        self.silent: set[str] = set()
        self.process = 1
        self.answer: Answer = self.answer_of_a_process
        self.heard: list[tuple[int, str]] = []  # port, method
        self.used: list[UsedClient] = []
        self.closed: list[str] = []

    def client(
        self,
        incarnation: Incarnation,
        *,
        pool: int = 0,
        limits: XmlRpcLimits = ANSWER,
        patience: float = 1.0,
    ) -> XmlRpcClient:
        self.used.append(UsedClient(incarnation.name, pool, limits))
        return _Client(self, incarnation)

    async def answer_of_a_process(
        self, node: Incarnation, method: str, _parameters: tuple[Value, ...]
    ) -> Value:
        if node.name in self.gone:
            raise RefusedError("nobody is there")
        if node.name in self.silent:
            raise UnansweredError("no answer")
        self.heard.append((node.api.port, method))
        return [1, "", self.process]


class _Client(XmlRpcClient):
    def __init__(self, nodes: ScriptedNodes, node: Incarnation) -> None:
        super().__init__(node.call_uri, timeout=3.0)
        self._nodes, self._node = nodes, node

    async def call(self, method: str, *params: Value) -> Value:
        return await self._nodes.answer(self._node, method, params)

    async def reaches(self, seconds: float) -> bool:
        return self._node.name not in self._nodes.gone

    def close(self) -> None:
        self._nodes.closed.append(self._node.name)
