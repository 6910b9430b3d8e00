from collections.abc import Callable
from typing import Any

from roswire.node.xmlrpc_http import call_xmlrpc, serve_xmlrpc
from roswire.uris import parse_node_uri
from roswire.xmlrpc import MethodCall, Value
from tests.support.memory_network import MemoryNetwork

MASTER = "http://10.0.0.1:11311/"


class ScriptedMaster:
    def __init__(self, network: MemoryNetwork) -> None:
        self.network = network
        self.publishers: dict[str, list[str]] = {}
        self.subscribers: dict[str, list[str]] = {}
        self.services: dict[str, str] = {}
        self.denials: dict[str, str] = {}  # the reason, by method
        self.answers: dict[str, Value] = {}  # values, by method
        self.before_answer: Callable[[MethodCall], Any] | None = None
        self.calls: list[str] = []
        self.server = network.listen(
            "10.0.0.1", lambda reader, writer: serve_xmlrpc(reader, writer, self.answer), 11311
        )

    async def answer(self, call: MethodCall) -> Value:
        self.calls.append(call.method)
        if self.before_answer is not None:
            await self.before_answer(call)
        if call.method in self.denials:
            return [-1, self.denials[call.method], 0]
        if call.method in self.answers:
            return [1, "", self.answers[call.method]]
        params: list[Any] = list(call.params)
        match call.method:
            case "registerSubscriber":
                self.subscribers.setdefault(params[1], []).append(params[3])
                return [1, "", [*self.publishers.get(params[1], [])]]
            case "registerPublisher":
                self.publishers.setdefault(params[1], []).append(params[3])
                await self.notify(params[1])
            case "unregisterPublisher":
                self.publishers[params[1]].remove(params[2])
                await self.notify(params[1])
            case "unregisterSubscriber":
                self.subscribers[params[1]].remove(params[2])
            case "registerService":
                self.services[params[1]] = params[2]
            case "unregisterService":
                del self.services[params[1]]
            case "lookupService":
                return (
                    [1, "", self.services[params[1]]]
                    if params[1] in self.services
                    else [-1, "no provider", ""]
                )
        return [1, "", 1]

    async def notify(self, topic: str) -> None:
        for uri in self.subscribers.get(topic, []):
            await self.call(uri, "publisherUpdate", topic, [*self.publishers[topic]])

    async def call(self, uri: str, method: str, *params: Value) -> Value:
        return await call_xmlrpc(
            self.network.at("10.0.0.1"), parse_node_uri(uri), method, ("/master", *params), seconds=5.0
        )
