"""Speak Foxglove's WebSocket protocol on one connection, without I/O: `foxglove.websocket.v1` and `foxglove.sdk.v1`.

Channels carry the bytes of ROS messages unchanged. The door announces only names that its identity may see. A refusal
is a status with the level error, or `serviceCallFailure`.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
from msgspec import UNSET, Raw

from appliance.base.counted import counted
from appliance.features.doors.client_frames import ClientFrame, binary_frame, frame_size, text_frame
from appliance.features.doors.client_requests import (
    AdvertiseTopic,
    CallOfService,
    DoorRequest,
    PublishMessage,
    ReadParameters,
    SubscribeParameter,
    SubscribeTopic,
    UnadvertiseTopic,
    UnsubscribeParameter,
    UnsubscribeTopic,
    WriteParameter,
)
from appliance.features.doors.door_memory import kept_bytes
from appliance.features.doors.foxglove_frames import (
    FOXGLOVE_OPERATION,
    FoxgloveAdvertise,
    FoxgloveChannel,
    FoxgloveFetchAsset,
    FoxgloveGetParameters,
    FoxgloveSetParameters,
    FoxgloveSubscribe,
    FoxgloveSubscribeGraph,
    FoxgloveSubscribeParameters,
    FoxgloveUnadvertise,
    FoxgloveUnsubscribe,
    FoxgloveUnsubscribeGraph,
    FoxgloveUnsubscribeParameters,
    channel_fields,
    service_fields,
)
from appliance.features.doors.known_types import DoorMessage
from appliance.features.doors.surroundings import DoorSurroundings, SeenService, SeenTopic
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.errors import DefinitionError, PeerError, quote
from roswire.names import resolve, resolve_parameter
from roswire.xmlrpc import Value

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
_ERROR = 2
_MESSAGE_DATA = struct.Struct("<BIQ")  # opcode 1, subscription, time in nanoseconds
_CLIENT_DATA = struct.Struct("<BI")  # opcode 1, channel
_SERVICE_CALL = struct.Struct(
    "<BIII"
)  # opcode 2 (request) or 3 (response), service, call, length of the encoding
_ASSET_RESPONSE = struct.Struct("<BIBI")  # opcode 4, request, status, length of the error
_ENCODINGS = ("ros1", "json")


@dataclass(frozen=True, slots=True)
class FoxgloveLimits:
    """Upper bounds for one connection."""

    subscriptions: int = 1000
    channels: int = 200  # of the client
    calls: int = 100
    parameters: int = 1000  # subscribed


class _FoxgloveError(PeerError):
    """A frame that cannot be carried out."""


class Foxglove:
    """The protocol of one connection."""

    wants_surroundings = True

    def __init__(self, node: str, limits: FoxgloveLimits, queue: ViewerQueue[int | str]) -> None:
        self.queue = queue
        self._node = node
        self._limits = limits
        self._ids: dict[SeenTopic | SeenService, int] = {}  # of what is announced; no number is used twice
        self._last_id = 0
        self._topics: dict[int, SeenTopic] = {}  # the announced channels
        self._services: dict[int, SeenService] = {}
        self._subscriptions: dict[int, int] = {}  # the channel, by the client's number
        self._by_topic: dict[str, set[int]] = {}
        self._channels: dict[
            int, tuple[str, str, int]
        ] = {}  # of the client: topic, encoding, bytes as charged
        # Channels whose advertisement was refused. A message repeats it, because viewers advertise only once.
        self._refused: dict[int, AdvertiseTopic] = {}
        self._calls: dict[int, tuple[int, int]] = {}  # service and call of the client
        self._number = 0
        self._parameters: dict[str, None] = {}  # subscribed, by canonical name
        self._graph: dict[str, dict[str, Sequence[str]]] | None = None  # as last sent to the client
        self._seen: DoorSurroundings | None = None
        self._changed: set[SeenTopic] = set()  # announced topics whose messages have another type
        self._carry_out: dict[type[Any], Callable[[Any], list[DoorRequest]]] = {
            FoxgloveSubscribe: self._subscribe,
            FoxgloveUnsubscribe: self._unsubscribe,
            FoxgloveAdvertise: self._advertise,
            FoxgloveUnadvertise: self._unadvertise,
            FoxgloveGetParameters: self._get_parameters,
            FoxgloveSetParameters: self._set_parameters,
            FoxgloveSubscribeParameters: self._subscribe_parameters,
            FoxgloveUnsubscribeParameters: self._unsubscribe_parameters,
            FoxgloveSubscribeGraph: self._subscribe_graph,
            FoxgloveUnsubscribeGraph: self._unsubscribe_graph,
            FoxgloveFetchAsset: self._fetch_asset,
        }
        self._tell(
            "serverInfo",
            name="rosrv door",
            capabilities=[
                "clientPublish",
                "parameters",
                "parametersSubscribe",
                "services",
                "connectionGraph",
            ],
            supportedEncodings=[*_ENCODINGS],
            metadata={"ROS_DISTRO": "noetic"},
        )

    def _tell(self, op: str, **fields: object) -> None:
        self.queue.reply(text_frame(msgspec.json.encode({"op": op} | fields)))

    # --- frames of the client ---

    def receive(self, frame: bytes, *, is_text: bool) -> list[DoorRequest]:
        try:
            if not is_text:
                return self._binary(frame)
            operation = FOXGLOVE_OPERATION.decode(frame)
            return self._carry_out[type(operation)](operation)
        except (PeerError, ValueError, RecursionError) as error:
            self._refuse(f"the operation is rejected: {error}")
            return []

    def _subscribe(self, operation: FoxgloveSubscribe) -> list[DoorRequest]:
        requests: list[DoorRequest] = []
        for subscription in operation.subscriptions:
            seen = self._topics.get(subscription.channelId)
            if seen is None:
                self._refuse(f"the channel {subscription.channelId} is not announced")
            elif subscription.id in self._subscriptions:
                self._refuse(f"the subscription {subscription.id} exists; unsubscribe it first")
            elif len(self._subscriptions) >= self._limits.subscriptions:
                self._refuse(
                    f"{len(self._subscriptions)} subscriptions; at most {self._limits.subscriptions}"
                )
            elif reason := self.queue.memory.refusal_to_keep():
                self._refuse(reason)
            else:
                self._subscriptions[subscription.id] = subscription.channelId
                self._by_topic.setdefault(seen.topic, set()).add(subscription.id)
                self.queue.configure(subscription.id, depth=None, interval=0.0)
                requests.append(SubscribeTopic(seen.topic, seen.type))
        return requests

    def _unsubscribe(self, operation: FoxgloveUnsubscribe) -> list[DoorRequest]:
        return [request for one in operation.subscriptionIds for request in self._end_subscription(one)]

    def _end_subscription(self, number: int) -> list[DoorRequest]:
        channel = self._subscriptions.pop(number, None)
        if channel is None:
            return []  # it ended with its channel
        topic = self._topics[channel].topic
        self.queue.remove(number)
        self._by_topic[topic].discard(number)
        if self._by_topic[topic]:
            return []
        del self._by_topic[topic]
        return [UnsubscribeTopic(topic)]

    def _advertise(self, operation: FoxgloveAdvertise) -> list[DoorRequest]:
        requests: list[DoorRequest] = []
        for channel in operation.channels:
            try:
                requests.append(self._advertise_channel(channel))
            except PeerError as error:
                self._refuse(str(error))
        return requests

    def _advertise_channel(self, channel: FoxgloveChannel) -> DoorRequest:
        if channel.encoding not in _ENCODINGS:
            raise _FoxgloveError(f"the encoding {quote(channel.encoding)}; use {' or '.join(_ENCODINGS)}")
        if channel.id in self._channels:
            raise _FoxgloveError(f"the channel {channel.id} exists; unadvertise it first")
        if len(self._channels) >= self._limits.channels:
            raise _FoxgloveError(
                f"{len(self._channels)} channels of this client; at most {self._limits.channels}"
            )
        if reason := self.queue.memory.refusal_to_keep():
            raise _FoxgloveError(reason)
        topic, kind = resolve(channel.topic, self._node), channel.schemaName.replace("/msg/", "/")
        self._channels[channel.id] = topic, channel.encoding, kept_bytes(topic, kind)
        self.queue.memory.keep(kept_bytes(topic, kind))
        return AdvertiseTopic(topic, kind, reply_to=channel.id)

    def _unadvertise(self, operation: FoxgloveUnadvertise) -> list[DoorRequest]:
        ended = [self._channels.pop(one) for one in operation.channelIds if one in self._channels]
        topics = {channel[0] for channel in ended}
        self.queue.memory.keep(-sum(channel[2] for channel in ended))
        self._refused = {one: request for one, request in self._refused.items() if one in self._channels}
        used = {channel[0] for channel in self._channels.values()}
        return [UnadvertiseTopic(topic) for topic in sorted(topics - used)]

    def _binary(self, frame: bytes) -> list[DoorRequest]:
        if frame[:1] == b"\x01" and len(frame) >= _CLIENT_DATA.size:
            _opcode, number = _CLIENT_DATA.unpack_from(frame)
            if number not in self._channels:
                raise _FoxgloveError(f"the channel {number} is not advertised by this client")
            topic, encoding, _charged = self._channels[number]
            publish = PublishMessage(topic, _values(encoding, frame[_CLIENT_DATA.size :]))
            again = self._refused.pop(number, None)
            return [publish] if again is None else [replace(again, repeated=True), publish]
        if frame[:1] == b"\x02" and len(frame) >= _SERVICE_CALL.size:
            return self._call(frame)
        raise _FoxgloveError(
            f"a binary frame of {len(frame)} bytes that begins with {frame[:1].hex() or 'nothing'}"
        )

    def _call(self, frame: bytes) -> list[DoorRequest]:
        _opcode, service, call, length = _SERVICE_CALL.unpack_from(frame)
        start = _SERVICE_CALL.size + length
        encoding = frame[_SERVICE_CALL.size : start][:20].decode("ascii", "replace")
        seen = self._services.get(service)
        reason = ""
        if seen is None:
            reason = f"the service {service} is not announced"
        elif start > len(frame) or encoding != "ros1":
            reason = f"the encoding {quote(encoding)} of a service call; use ros1"
        elif len(self._calls) >= self._limits.calls:
            waiting = counted(len(self._calls), "call of this client waits", "calls of this client wait")
            reason = f"{waiting} for answers; repeat it later"
        if reason or seen is None:
            self._fail_call(service, call, reason)
            return []
        self._number += 1
        self._calls[self._number] = service, call
        return [CallOfService(seen.service, self._number, frame[start:], type=seen.type)]

    def _get_parameters(self, operation: FoxgloveGetParameters) -> list[DoorRequest]:
        return [ReadParameters(tuple(operation.parameterNames), operation.id)]

    def _set_parameters(self, operation: FoxgloveSetParameters) -> list[DoorRequest]:
        requests: list[DoorRequest] = [
            WriteParameter(one.name, None if one.value is UNSET else one.value, operation.id)
            for one in operation.parameters
        ]
        if operation.id is not None:
            requests.append(ReadParameters(tuple(one.name for one in operation.parameters), operation.id))
        return requests

    def _subscribe_parameters(self, operation: FoxgloveSubscribeParameters) -> list[DoorRequest]:
        requests: list[DoorRequest] = []
        for name in self._parameter_names(operation.parameterNames or ["/"]):
            if name in self._parameters:
                continue
            if len(self._parameters) >= self._limits.parameters:
                self._refuse(
                    f"{name}: {len(self._parameters)} subscribed parameters; at most {self._limits.parameters}"
                )
                break
            if reason := self.queue.memory.refusal_to_keep():
                self._refuse(reason)
                break
            self._parameters[name] = None
            self.queue.configure(name, depth=None, interval=0.0)
            requests.append(SubscribeParameter(name))
        return requests

    def _unsubscribe_parameters(self, operation: FoxgloveUnsubscribeParameters) -> list[DoorRequest]:
        names = self._parameter_names(operation.parameterNames) or [*self._parameters]
        ended = [name for name in names if name in self._parameters]
        for name in ended:
            self._end_parameter(name)
        return [UnsubscribeParameter(name) for name in ended]

    def _parameter_names(self, names: Sequence[str]) -> list[str]:
        return [*dict.fromkeys(resolve_parameter(name, self._node) for name in names)]

    def _end_parameter(self, name: str) -> None:
        self._parameters.pop(name, None)
        self.queue.remove(name)

    def _subscribe_graph(self, _operation: FoxgloveSubscribeGraph) -> list[DoorRequest]:
        self._graph = {"publishedTopics": {}, "subscribedTopics": {}, "advertisedServices": {}}
        if self._seen is not None:
            self._send_graph(self._seen)
        return []

    def _unsubscribe_graph(self, _operation: FoxgloveUnsubscribeGraph) -> list[DoorRequest]:
        self._graph = None
        return []

    def _fetch_asset(self, operation: FoxgloveFetchAsset) -> list[DoorRequest]:
        reason = b"this door has no assets"
        self.queue.reply(binary_frame(_ASSET_RESPONSE.pack(4, operation.requestId, 1, len(reason)), reason))
        return []

    # --- answers and refusals ---

    def _refuse(self, text: str) -> None:
        self._tell("status", level=_ERROR, message=text)

    def _fail_call(self, service: int, call: int, text: str) -> None:
        self._tell("serviceCallFailure", serviceId=service, callId=call, message=text)

    def failed(self, request: DoorRequest, reason: str) -> None:
        match request:
            case CallOfService():
                service, call = self._calls.pop(request.call, (0, 0))
                self._fail_call(service, call, reason)
                return
            case AdvertiseTopic(topic):
                self._refused |= {one: request for one, row in self._channels.items() if row[0] == topic}
            case SubscribeTopic(topic):
                for number in [*self._by_topic.get(topic, ())]:
                    self._end_subscription(number)
            case SubscribeParameter(name):
                self._end_parameter(name)
        self._refuse(reason)

    def answered(self, number: int, values: Raw | bytes) -> None:
        if number in self._calls:
            service, call = self._calls.pop(number)
            head = _SERVICE_CALL.pack(3, service, call, len(_ENCODINGS[0])) + _ENCODINGS[0].encode("ascii")
            self.queue.reply(binary_frame(head, bytes(values)))

    def parameters(self, values: Mapping[str, object], reply_to: str | None) -> None:
        rows = [{"name": name, "value": value} for name, value in values.items()]
        self._tell("parameterValues", parameters=rows, **({} if reply_to is None else {"id": reply_to}))

    def parameter_changed(self, subscribed: str, name: str, value: Value, now: float) -> None:
        row = {"name": name} if value == {} else {"name": name, "value": value}
        frame = text_frame(msgspec.json.encode({"op": "parameterValues", "parameters": [row]}))
        self.queue.put(subscribed, frame, frame_size(frame), now)

    def ask(self, service: str, _values: Raw) -> str:
        raise _FoxgloveError(f"the client does not offer {service}")

    def give_up(self, _call: str) -> None: ...

    # --- what the door sees ---

    def surroundings(self, seen: DoorSurroundings) -> list[DoorRequest]:
        """Announce changes, and return the ends of subscriptions to withdrawn channels, for which clients send no
        frame.
        """
        if seen.denial and (self._seen is None or self._seen.denial != seen.denial):
            self._refuse(seen.denial)
        first, self._seen = self._seen is None, seen
        announced: list[SeenTopic | SeenService] = [*seen.topics, *seen.services]
        self._ids = {one: self._ids.get(one) or self._new_id() for one in announced}
        topics = {self._ids[topic]: topic for topic in seen.topics}
        services = {self._ids[service]: service for service in seen.services}
        if gone := [topic for topic in self._topics if topic not in topics]:
            self._tell("unadvertise", channelIds=gone)
        new = [topic for topic in topics if topic not in self._topics]
        if new or first:
            self._tell("advertise", channels=[channel_fields(one, topics[one]) for one in new])
        if gone := [service for service in self._services if service not in services]:
            self._tell("unadvertiseServices", serviceIds=gone)
        if new := [service for service in services if service not in self._services]:
            self._tell("advertiseServices", services=[service_fields(one, services[one]) for one in new])
        ended = [
            request
            for number, channel in [*self._subscriptions.items()]
            if channel not in topics
            for request in self._end_subscription(number)
        ]
        self._topics, self._services = topics, services
        self._changed &= {*seen.topics}
        if self._graph is not None:
            self._send_graph(seen)
        return ended

    def _new_id(self) -> int:
        self._last_id += 1
        return self._last_id

    def _send_graph(self, seen: DoorSurroundings) -> None:
        now: dict[str, dict[str, Sequence[str]]] = {
            "publishedTopics": dict(seen.graph.publishers),
            "subscribedTopics": dict(seen.graph.subscribers),
            "advertisedServices": dict(seen.graph.services),
        }
        before, self._graph = self._graph or now, now
        keys = {
            "publishedTopics": "publisherIds", "subscribedTopics": "subscriberIds", "advertisedServices": "providerIds",
        }  # fmt: skip
        changed = {
            part: [
                {"name": name, ids: [*nodes]}
                for name, nodes in now[part].items()
                if before[part].get(name) != nodes
            ]
            for part, ids in keys.items()
        }
        topics = {*now["publishedTopics"], *now["subscribedTopics"]}
        removed = sorted({*before["publishedTopics"], *before["subscribedTopics"]} - topics)
        services = sorted({*before["advertisedServices"]} - {*now["advertisedServices"]})
        if any(changed.values()) or removed or services:
            self._tell("connectionGraphUpdate", **changed, removedTopics=removed, removedServices=services)

    def message(self, message: DoorMessage, now: float) -> None:
        try:
            fingerprint = message.type.key.fingerprint
        except DefinitionError:
            fingerprint = ""
        for number in self._by_topic.get(message.topic, ()):
            seen = self._topics[self._subscriptions[number]]
            if seen.fingerprint == fingerprint:
                self.queue.put(number, message, len(message.body), now)
            elif seen not in self._changed:  # the next look announces the topic with its definition
                self._changed.add(seen)
                md5sum = message.header.get("md5sum", "")[:32]
                changed = (
                    "another definition"
                    if md5sum == seen.md5sum
                    else f"the md5sum {md5sum}, not {seen.md5sum}"
                )
                self._refuse(f"{seen.topic} has {changed}: subscribe to it again")

    def warned(self, reason: str) -> None:
        self._refuse(reason)

    def next_frame(self, now: float) -> ClientFrame | None:
        taken = self.queue.take(now)
        if taken is None or taken[0] is None:
            return None if taken is None else taken[1]
        number, message = taken
        if isinstance(number, int):
            frame: ClientFrame = message.frame(number, _message_frame)
            return frame
        changed: ClientFrame = message  # of a parameter
        return changed

    def next_time(self) -> float | None:
        return self.queue.next_time()


def _message_frame(message: DoorMessage, number: int) -> ClientFrame:
    return binary_frame(_MESSAGE_DATA.pack(1, number, message.received), message.body)


def _values(encoding: str, data: bytes) -> Raw | bytes:
    return Raw(data) if encoding == "json" else data
