"""The node API (slave API): calls of the master and other nodes to a node."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from roswire.node.services import ServiceServer
from roswire.node.topics import NodePublication, NodeSubscription
from roswire.xmlrpc import MethodCall, Value

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
        if not any(isinstance(one, list) and one[:1] == ["TCPROS"] for one in protocols):
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
