"""The node: registers with the master, serves its API, and owns its topics and services.

Invariants:

1. A topic, service or subscribed parameter is in the node's tables from before its registration until after its
   unregistration, so a call of the master about it always finds it.
2. Registrations of one name happen one after another.
3. After `close`, the node has no task and no connection.
"""

import asyncio
import contextlib
import os
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Literal, Protocol
from weakref import WeakValueDictionary

from roswire.errors import InvalidUriError, ProtocolError, RosError
from roswire.names import resolve_parameter
from roswire.node.network import (
    ByteWriter,
    ListeningServer,
    MasterDenialError,
    NodeMemory,
    NodeNetwork,
    OwnedTasks,
)
from roswire.node.services import ServiceServer, ServiceType, call_service, probe_service
from roswire.node.tcpros_streams import ANY_TYPE, MessageType, NodeLimits, read_header, refuse
from roswire.node.topics import (
    NodeLink,
    NodePublication,
    NodeSubscription,
    OwnMemory,
    Received,
    SendQueues,
)
from roswire.node.xmlrpc_http import call_xmlrpc, serve_xmlrpc
from roswire.uris import NodeUri, node_uri, parse_node_uri, parse_service_uri, service_uri
from roswire.xmlrpc import FaultReceived, MethodCall, Value

# The node API (slave API): calls of the master and other nodes to a node.

ParameterChanged = Callable[[str, Value], None]
"""Takes a changed key and its new value, which is `{}` if the key was deleted."""

_DONE: list[Value] = [1, "", 0]


class NodeTables(Protocol):
    """The tables of a node, which the API reads."""

    @property
    def publishers(self) -> Mapping[str, NodePublication]: ...

    @property
    def subscribers(self) -> Mapping[str, NodeSubscription]: ...

    @property
    def services(self) -> Mapping[str, ServiceServer]: ...

    @property
    def parameters(self) -> Mapping[str, ParameterChanged]: ...

    @property
    def tcpros(self) -> tuple[str, int]: ...
    def follow(self, subscriber: NodeSubscription, uris: Sequence[Value]) -> None: ...


class NodeApi:
    """The API of a node. A call with parameters other than those of the API gets an error and has no effect."""

    def __init__(self, node: NodeTables, master: str, pid: int, shut_down: Callable[[str], None]) -> None:
        self._node = node
        self._shut_down = shut_down
        self._queries: dict[str, Callable[[], Value]] = {
            "getPid": lambda: pid,
            "getMasterUri": lambda: master,
            "getPublications": lambda: [[one.topic, one.type.name] for one in node.publishers.values()],
            "getSubscriptions": lambda: [[one.topic, one.wanted.name] for one in node.subscribers.values()],
            "getBusInfo": self._bus_info,
            "getBusStats": lambda: [[], [], []],
        }

    async def answer(self, call: MethodCall) -> Value:
        answer: Value
        match call.method, call.params:
            case "publisherUpdate", (str(), str(topic), list(uris)):
                answer = self._update(topic, uris)
            case "requestTopic", (str(), str(topic), list(protocols)):
                answer = self._request_topic(topic, protocols)
            case "paramUpdate", (str(), str(key), value):
                answer = self._parameter_update(key.rstrip("/") or "/", value)
            case "shutdown", (str(), *reason):
                self._shut_down(str(reason[0])[:1000] if reason else "")
                answer = _DONE
            case method, (str(),) if method in self._queries:
                answer = [1, "", self._queries[method]()]
            case _:
                answer = [
                    -1,
                    f"{call.method[:100]} is not a call of the node API with these parameters",
                    0,
                ]
        return answer

    def _update(self, topic: str, uris: list[Value]) -> Value:
        subscriber = self._node.subscribers.get(topic)
        if subscriber is None:
            return [0, f"this node does not subscribe to {topic[:200]}", 0]
        self._node.follow(subscriber, uris)
        return _DONE

    def _parameter_update(self, key: str, value: Value) -> Value:
        told = [
            changed
            for subscribed, changed in self._node.parameters.items()
            if key == subscribed or key.startswith(f"{subscribed.rstrip('/')}/")
        ]
        if not told:
            return [0, f"this node does not subscribe to the parameter {key[:200]}", 0]
        for changed in told:
            changed(key, value)
        return _DONE

    def _request_topic(self, topic: str, protocols: list[Value]) -> Value:
        if topic not in self._node.publishers:
            return [0, f"this node does not publish {topic[:200]}", 0]
        if not any(isinstance(protocol, list) and protocol[:1] == ["TCPROS"] for protocol in protocols):
            return [0, "this node offers TCPROS only", 0]
        return [1, "", ["TCPROS", *self._node.tcpros]]

    def _bus_info(self) -> list[Value]:
        connections: list[tuple[str, str, str]] = [
            (name, "o", publisher.topic)
            for publisher in self._node.publishers.values()
            for name in publisher.subscribers
        ] + [
            (uri, "i", subscriber.topic)
            for subscriber in self._node.subscribers.values()
            for uri in subscriber.connected
        ]
        return [
            [number, peer, way, "TCPROS", topic, True]
            for number, (peer, way, topic) in enumerate(connections, 1)
        ]


_CLOSE_SECONDS = 2.0  # for all unregistrations together
_Kind = Literal["publisher", "subscriber", "service", "parameter"]


class RosNode:
    """A node with a canonical `name`; `master` is a URI.

    `shut_down` is called with the reason if the master ends the node, for example because another node took its name.
    `memory` bounds the messages that wait for other nodes. `skipped` is called for each message that is dropped
    because of `NodeLimits.arriving_bytes`.
    """

    def __init__(
        self,
        name: str,
        master: str,
        network: NodeNetwork,
        *,
        limits: NodeLimits,
        shut_down: Callable[[str], None],
        memory: NodeMemory | None = None,
        skipped: Callable[[], None] = lambda: None,
    ) -> None:
        self.name = name
        self.publishers: dict[str, NodePublication] = {}
        self.subscribers: dict[str, NodeSubscription] = {}
        self.services: dict[str, ServiceServer] = {}
        self.parameters: dict[str, ParameterChanged] = {}
        self._master: NodeUri = parse_node_uri(master)
        self._network = network
        self._limits = limits
        queues = SendQueues(memory or OwnMemory(limits.queue_bytes))
        self._link = NodeLink(name, network, limits, queues, OwnMemory(limits.arriving_bytes), skipped)
        self._api = NodeApi(self, master, os.getpid(), shut_down)
        self._tasks = OwnedTasks()
        self._servers: list[ListeningServer] = []
        self._uri = ""
        self._locks: WeakValueDictionary[tuple[_Kind, str], asyncio.Lock] = WeakValueDictionary()

    async def start(self) -> None:
        """Listen on the source address. Raise `OSError` if that is not possible."""
        for serve in (self._serve_api, self._serve_tcpros):
            self._servers.append(await self._network.serve(serve))
        self._uri = node_uri(self._network.source, self._servers[0].port)

    @property
    def uri(self) -> str:
        return self._uri

    @property
    def tcpros(self) -> tuple[str, int]:
        return self._network.source, self._servers[1].port

    async def close(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLOSE_SECONDS):
                await self._unregister_all()
        for publisher in self.publishers.values():
            await publisher.close()
        for subscriber in self.subscribers.values():
            await subscriber.close()
        for server in self._servers:
            server.close()
        await self._tasks.close()

    async def _unregister_all(self) -> None:
        for service in [*self.services]:
            await self.withdraw(service)
        for topic in [*self.subscribers]:
            await self.unsubscribe(topic)
        for topic in [*self.publishers]:
            await self.unadvertise(topic)
        for key in [*self.parameters]:
            await self.unsubscribe_parameter(key)

    # --- the master ---

    async def master(self, method: str, *params: Value) -> Value:
        """Call the master. Raise `MasterDenialError` with its reason, or another `RosError`."""
        return await self._call_master(self.name, method, *params)

    async def _call_master(self, caller_id: str, method: str, *params: Value) -> Value:
        try:
            answer = await call_xmlrpc(
                self._network, self._master, method, (caller_id, *params), seconds=self._limits.call_seconds
            )
        except ProtocolError as error:
            if isinstance(error.__cause__, FaultReceived):
                raise MasterDenialError(error.__cause__.text[:4000]) from None
            raise
        match answer:
            case [1, str(), value]:
                return value
            case [int(), str(text), _]:
                raise MasterDenialError(text[:4000])
        raise ProtocolError(f"the master gave no valid answer to {method}")

    # --- topics ---

    async def subscribe(
        self, topic: str, received: Received, wanted: MessageType = ANY_TYPE
    ) -> NodeSubscription:
        """Subscribe to a topic. Raise ValueError if the node already does, and `RosError` if the master denies it."""
        async with self._lock("subscriber", topic):
            if topic in self.subscribers:
                raise ValueError(f"{self.name} already subscribes to {topic}")
            subscriber = self.subscribers[topic] = NodeSubscription(self._link, topic, wanted, received)
            try:
                uris = await self.master("registerSubscriber", topic, wanted.name, self._uri)
            except BaseException:
                await self.subscribers.pop(topic).close()
                raise
            if not subscriber.updates:  # else an update, which is newer, overtook the answer
                self.follow(subscriber, uris if isinstance(uris, list) else [])
            if topic in self.publishers:
                self.publishers[topic].repeat(subscriber.hear_own)
            return subscriber

    def repeat(self, topic: str, received: Received) -> None:
        self.subscribers[topic].repeat(received)
        if topic in self.publishers:
            self.publishers[topic].repeat(received)

    def follow(self, subscriber: NodeSubscription, uris: Sequence[Value]) -> None:
        subscriber.update([uri for uri in uris if isinstance(uri, str) and uri != self._uri])

    async def subscribe_again(self, topic: str) -> None:
        """Register a subscription again, to learn whether the master still grants it. Raise `RosError` if not."""
        subscriber = self.subscribers[topic]
        updates = subscriber.updates
        uris = await self.master("registerSubscriber", topic, subscriber.wanted.name, self._uri)
        if subscriber.updates == updates:  # else an update, which is newer, overtook the answer
            self.follow(subscriber, uris if isinstance(uris, list) else [])

    async def unsubscribe(self, topic: str) -> None:
        async with self._lock("subscriber", topic):
            if topic in self.subscribers:
                await self._forget("unregisterSubscriber", topic, self._uri)
                await self.subscribers.pop(topic).close()

    async def advertise(
        self, topic: str, kind: MessageType, *, latched: bool, queue: int, replay: float = 0.0
    ) -> NodePublication:
        """Publish a topic. At most `queue` messages wait for each subscriber.

        Subscribers that connect within `replay` seconds get all messages published in that time. Raise ValueError if
        the node already publishes the topic, and `RosError` if the master denies it.
        """
        async with self._lock("publisher", topic):
            if topic in self.publishers:
                raise ValueError(f"{self.name} already publishes {topic}")
            publisher = self.publishers[topic] = NodePublication(
                self._link,
                topic,
                kind,
                latched=latched,
                queue=queue,
                replay=replay,
                own=lambda: self.subscribers.get(topic),
            )
            try:
                await self.master("registerPublisher", topic, kind.name, self._uri)
            except BaseException:
                await self.publishers.pop(topic).close()
                raise
            return publisher

    async def advertise_again(self, topic: str) -> None:
        """Register a publication again, to learn whether the master still grants it. Raise `RosError` if not."""
        await self.master("registerPublisher", topic, self.publishers[topic].type.name, self._uri)

    async def unadvertise(self, topic: str) -> None:
        async with self._lock("publisher", topic):
            if topic in self.publishers:
                await self._forget("unregisterPublisher", topic, self._uri)
                await self.publishers.pop(topic).close()

    # --- parameters ---

    async def subscribe_parameter(self, key: str, changed: ParameterChanged) -> None:
        """Call `changed` for each new value of a canonical key, or of a key below it.

        Raise ValueError if the node already subscribes to the key, and `RosError` if the master denies it.
        """
        async with self._lock("parameter", key):
            if key in self.parameters:
                raise ValueError(f"{self.name} already subscribes to the parameter {key}")
            self.parameters[key] = changed
            try:
                await self.master("subscribeParam", self._uri, key)
            except BaseException:
                del self.parameters[key]
                raise

    async def subscribe_parameter_again(self, key: str) -> None:
        """Register a subscription again, to learn whether the master still grants it. Raise `RosError` if not."""
        await self.master("subscribeParam", self._uri, key)

    async def unsubscribe_parameter(self, key: str) -> None:
        async with self._lock("parameter", key):
            if key in self.parameters:
                await self._forget("unsubscribeParam", self._uri, key)
                del self.parameters[key]

    async def set_parameter(self, name: str, value: Value) -> None:
        """Set a parameter as the caller NODE/parameters. Raise `RosError`.

        A master sends no update to the node that sets a parameter. With another caller's name, this node's own
        subscriptions get all values, in the master's order.
        """
        key = resolve_parameter(name, self.name)
        await self._call_master(f"{self.name}/parameters", "setParam", key, value)

    # --- services ---

    async def offer(
        self, service: str, kind: ServiceType, answer: Callable[[bytes], Awaitable[bytes]]
    ) -> ServiceServer:
        """Offer a service. Raise ValueError if the node already does, and `RosError` if the master denies it."""
        async with self._lock("service", service):
            if service in self.services:
                raise ValueError(f"{self.name} already offers {service}")
            server = self.services[service] = ServiceServer(self._link, service, kind, answer)
            try:
                await self.master("registerService", service, service_uri(*self.tcpros), self._uri)
            except BaseException:
                del self.services[service]
                raise
            return server

    async def withdraw(self, service: str) -> None:
        async with self._lock("service", service):
            if service in self.services:
                await self._forget("unregisterService", service, service_uri(*self.tcpros))
                del self.services[service]

    async def probe_service(self, service: str) -> dict[str, str]:
        """Return the connection header of a service, which has its `type` and `md5sum`. Raise `RosError`."""
        return await probe_service(self._link, service, await self._service_uri(service))

    async def call_service(self, service: str, md5sum: str, request: bytes, seconds: float) -> bytes:
        """Return the serialised response. Raise `ServiceFailedError` with a reason, or another `RosError`."""
        uri = await self._service_uri(service)
        return await call_service(self._link, service, uri, md5sum=md5sum, request=request, seconds=seconds)

    async def _service_uri(self, service: str) -> NodeUri:
        uri = await self.master("lookupService", service)
        if not isinstance(uri, str):
            raise InvalidUriError(f"the master gave no URI of {service}")
        return parse_service_uri(uri)

    # --- connections of other nodes ---

    async def _serve_api(self, reader: asyncio.StreamReader, writer: ByteWriter) -> None:
        if self._accept(writer):
            await serve_xmlrpc(reader, writer, self._api.answer)

    async def _serve_tcpros(self, reader: asyncio.StreamReader, writer: ByteWriter) -> None:
        if self._accept(writer):
            with contextlib.suppress(RosError, OSError):  # the peer broke the protocol or the connection
                await self._serve_header(reader, writer)

    def _accept(self, writer: ByteWriter) -> bool:
        if len(self._tasks) >= self._limits.connections:
            writer.close()
            return False
        self._tasks.own_current()
        return True

    async def _serve_header(self, reader: asyncio.StreamReader, writer: ByteWriter) -> None:
        try:
            header = await read_header(reader, self._limits.header_seconds)
            if "service" in header:
                service = self.services.get(header["service"])
                if service is None:
                    refuse(writer, f"{self.name} does not offer the service {header['service'][:200]}")
                else:
                    await service.serve(reader, writer, header)
            else:
                publisher = self.publishers.get(header.get("topic", ""))
                if publisher is None:
                    refuse(writer, f"{self.name} does not publish {header.get('topic', '')[:200]}")
                else:
                    await publisher.serve(reader, writer, header)
        finally:
            writer.close()

    # --- small helpers ---

    def _lock(self, kind: _Kind, name: str) -> asyncio.Lock:
        lock = self._locks.get((kind, name)) or asyncio.Lock()
        self._locks[kind, name] = lock
        return lock

    async def _forget(self, method: str, *params: Value) -> None:
        """Call the master, and ignore errors: if it has ended, it has lost the registration or will miss the node."""
        with contextlib.suppress(RosError):
            await self.master(method, *params)
