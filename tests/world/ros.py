"""Scripted ROS nodes, and a model of `rosmaster`.

Nodes behave as rospy and roscpp do: they connect to each new publisher, retry broken connections, repeat a call whose
outcome is unknown, and end on a shutdown request. They ignore updates of a topic during their own registering call
for it, a race that also exists with a plain ROS master.
"""

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

from appliance.rpc.server import Peer
from roswire.errors import PeerError
from roswire.uris import parse_node_uri, parse_service_uri
from roswire.xmlrpc import Value, build_call, build_response, parse_call, parse_response
from tests.world.loop import Process
from tests.world.network import LOST

if TYPE_CHECKING:
    from tests.world.world import World

_CALL_SECONDS = 30.0
_AGAIN_SECONDS = 0.5
_NOBODY_KNOWS = "not come back", "does not answer"  # in the answer to a call that may have been carried out


@dataclass(eq=False)
class Subscription:
    known: list[str] = field(default_factory=list)
    ports: dict[str, int] = field(default_factory=dict)


class Node:
    def __init__(self, world: "World", process: Process, name: str, port: int) -> None:
        self.world = world
        self.process = process
        self.name = name
        self.host = process.machine.name
        self.port = port
        self.pid = world.number()
        self.answers = True
        self.superseded = False
        self.publishes: set[str] = set()
        self.subscribes: dict[str, Subscription] = {}
        self.services: set[str] = set()
        self.calling: set[tuple[str, str]] = set()
        self._one_update = asyncio.Lock()
        self.api = f"http://{self.host}:{port}/"
        process.run(world.network.serve, (self.host, port), self._answer)

    def __str__(self) -> str:
        return f"{self.name} at {self.host}:{self.port}"

    @property
    def alive(self) -> bool:
        return self.process.alive

    # --- the node's API ---

    async def _answer(self, _peer: Peer, body: bytes) -> bytes:
        if not self.answers:
            await asyncio.get_running_loop().create_future()
        call = parse_call(body)
        match call.method:
            case "publisherUpdate":
                _caller, topic, uris = call.params
                self.process.start(self._updated(str(topic), [str(uri) for uri in cast(list[Value], uris)]))
            case "shutdown":
                self.process.call(0.0, self.world.ends, self)
            case "requestTopic":
                return build_response([1, "", ["TCPROS", self.host, self.port]])
        return build_response([1, "", self.pid])

    # --- calls ---

    async def call(self, uri: str, method: str, *params: Value) -> list[Any]:
        there = parse_node_uri(uri)
        body = build_call(method, (self.name, *params))
        answer = await self.world.network.exchange((there.host, there.port), body, _CALL_SECONDS, self.host)
        try:
            return cast(list[Any], parse_response(answer))
        except PeerError as error:  # a fault: the host is unknown
            return [-1, str(error), 0]

    def register(self, method: str, resource: str) -> None:
        if (method, resource) not in self.calling:
            self.calling.add((method, resource))
            self.process.start(self._register(method, resource))

    async def _register(self, method: str, resource: str) -> None:
        self.world.say(f"{self} {method} {resource}")
        given: tuple[Value, ...] = (resource, "std_msgs/String", self.api)
        if method == "registerService":
            given = (resource, f"rosrpc://{self.host}:{self.port}", self.api)
        elif method == "unregisterService":
            given = (resource, f"rosrpc://{self.host}:{self.port}")
        elif method.startswith("unregister"):
            given = (resource, self.api)
        while True:
            try:
                answer = await self.call(self.world.master_uri, method, *given)
            except LOST:
                await asyncio.sleep(_AGAIN_SECONDS)
                continue
            if answer[0] == 1 or not any(text in str(answer[1]) for text in _NOBODY_KNOWS):
                break
        self.calling.discard((method, resource))
        self.world.say(f"  {self} is answered {method} {resource}: {answer[:2]}")
        if method.startswith("register"):
            self._registered(method, resource, answer)

    def _registered(self, method: str, resource: str, answer: list[Any]) -> None:
        if answer[0] == 1:
            self.world.takes_name(self)
            self.world.acknowledged(self, method, resource)
            if method == "registerSubscriber":
                self._update(resource, answer[2])
        elif method == "registerPublisher":
            self.publishes.discard(resource)
        elif method == "registerSubscriber":
            self.subscribes.pop(resource, None)
        else:
            self.services.discard(resource)

    # --- topics ---

    async def _updated(self, topic: str, uris: list[str]) -> None:
        async with self._one_update:  # in the order in which they arrived
            while ("registerSubscriber", topic) in self.calling:
                await asyncio.sleep(0.01)
            self._update(topic, uris)

    def _update(self, topic: str, uris: list[str]) -> None:
        self.world.sees(self, uris)
        subscription = self.subscribes.get(topic)
        if subscription is None:
            return
        self.world.say(f"  {self} is told {topic} {uris}")
        uris = [uri for uri in uris if uri != self.api]  # its own publications stay within the process
        new = [uri for uri in uris if uri not in subscription.known]
        for uri in subscription.known:
            if uri not in uris:
                self.world.disconnect(self, topic, subscription.ports.pop(uri, 0))
        subscription.known = list(uris)
        for uri in new:
            self.process.start(self._request(topic, subscription, uri))

    async def _request(self, topic: str, subscription: Subscription, uri: str) -> None:
        try:
            answer = await self.call(uri, "requestTopic", topic, [["TCPROS"]])
        except LOST:
            answer = [0, "no answer"]
        self.world.say(f"  {self} asked {uri} for {topic}: {answer!r}")
        if uri in subscription.known:
            if answer[0] == 1:
                subscription.ports[uri] = answer[2][2]
            elif uri not in subscription.ports:  # a later request for this URI may have succeeded
                subscription.known.remove(uri)

    async def connect(self) -> None:
        while True:
            await asyncio.sleep(_AGAIN_SECONDS)
            if self.answers:
                for topic, subscription in self.subscribes.items():
                    for port in subscription.ports.values():
                        self.world.connect(self, topic, port)

    # --- services and parameters ---

    async def use_service(self, service: str) -> None:
        try:
            answer = await self.call(self.world.master_uri, "lookupService", service)
        except LOST:
            return
        self.world.say(f"{self} lookupService {service}: {answer!r}")
        if answer[0] == 1:
            self.world.sees(self, [str(answer[2])])
            self.world.call_service(self, service, parse_service_uri(answer[2]).port)

    async def set_parameter(self, key: str, value: int) -> None:
        try:
            answer = await self.call(self.world.master_uri, "setParam", key, value)
        except LOST:
            answer = [-1, "no answer"]
        self.world.say(f"{self} setParam {key} {value}: {answer[:2]}")
        self.world.parameter_set(key, known=answer[0] == 1)

    async def get_parameter(self, key: str) -> None:
        with self.world.reading(key) as possible:
            try:
                answer = await self.call(self.world.master_uri, "getParam", key)
            except LOST:
                return
        self.world.say(f"{self} getParam {key}: {answer!r}")
        value = answer[2] if answer[0] == 1 else None
        if (answer[0] == 1 or "is not set" in str(answer[1])) and value not in possible:
            self.world.fail(f"{self} reads {key} as {value!r}, which is not one of {possible}")


class RosMaster:
    def __init__(self, world: "World", process: Process, port: int) -> None:
        self._world = world
        self.pid = world.number()
        self.process = process
        self.tables: dict[str, dict[str, dict[str, str]]] = {"Publisher": {}, "Subscriber": {}, "Service": {}}
        self.services: dict[str, str] = {}
        self.nodes: dict[str, str] = {}
        self.parameters: dict[str, Any] = {}
        process.run(world.network.serve, ("127.0.0.1", port), self._answer)

    async def _answer(self, _peer: Peer, body: bytes) -> bytes:
        call = parse_call(body)
        if call.method == "system.multicall":
            parts = cast(list[dict[str, Any]], call.params[0])
            return build_response([[self._carry_out(part["methodName"], part["params"])] for part in parts])
        return build_response(self._carry_out(call.method, list(call.params)))

    def _carry_out(self, method: str, params: list[Any]) -> list[Value]:
        for how in ("register", "unregister"):
            table = self.tables.get(method.removeprefix(how))
            if table is not None and method.startswith(how):
                return self._change(how, method.removeprefix(how), table, *params)
        return self._known(method, params)

    def _known(self, method: str, params: list[Any]) -> list[Value]:
        value: Value = 0
        match method:
            case "getPid":
                value = self.pid
            case "getSystemState":
                value = [
                    [[one, [*nodes]] for one, nodes in table.items() if nodes]
                    for table in self.tables.values()
                ]
            case "getTopicTypes":
                value = []
            case "lookupNode" | "lookupService":
                value = (self.nodes if method == "lookupNode" else self.services).get(params[1], "")
                if not value:
                    return [-1, "unknown", ""]
            case "subscribeParam" | "unsubscribeParam":
                pass
            case _:
                return self._parameter(method, params)
        return [1, "", value]

    def _parameter(self, method: str, params: list[Any]) -> list[Value]:
        *above, last = [part for part in params[1].split("/") if part] or [""]
        tree = self.parameters
        for part in above:
            tree = tree.setdefault(part, {})
        match method:
            case "setParam" if last:
                tree[last] = params[2]
            case "setParam":
                self.parameters = dict(params[2])
            case "deleteParam":
                tree.pop(last, None)
            case "hasParam":
                return [1, "", last in tree]
            case "getParam":
                if last and last not in tree:
                    return [-1, f"Parameter [{params[1]}] is not set", 0]
                return [1, "", tree[last] if last else tree]
            case _:
                raise AssertionError(f"the model of rosmaster does not know {method}")
        return [1, "", 0]

    def _change(
        self, how: str, kind: str, table: dict[str, dict[str, str]], name: str, resource: str, *rest: str
    ) -> list[Value]:
        holders = table.setdefault(resource, {})
        if how == "unregister":
            return [1, "", int(holders.pop(name, None) is not None)]
        if self.nodes.get(name, rest[-1]) != rest[-1]:  # another process has the name: the old one loses all
            for one in self.tables.values():
                for others in one.values():
                    others.pop(name, None)
            holders = table.setdefault(resource, {})
        if kind == "Service":
            holders.clear()  # it keeps the last provider
            self.services[resource] = rest[0]
        holders[name] = rest[-1]
        self.nodes[name] = rest[-1]
        return [1, "", []]
