"""Speak the rosbridge protocol, version 2, on one connection, without I/O.

1. Every refusal has its reason: a `status` of level error with the id of the operation, also one without an id when
   the reason is new, or a failed `service_response`. Nothing else is sent without a request.
2. Frames repeat the client's own spelling of a name; requests have the canonical name.
3. Everything that a client can make grow has a limit, and is charged to the client's share of its door's memory.
4. No fragments and no images of texts (`png`) are sent or read. A subscription that asks for them gets plain JSON,
   and a `status` of level warning.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from msgspec import Raw

from appliance.base.counted import counted
from appliance.features.doors.client_frames import ClientFrame, frame_size
from appliance.features.doors.client_requests import (
    AdvertiseTopic,
    AnswerCall,
    CallOfService,
    ClientId,
    DoorRequest,
    OfferService,
    PublishMessage,
    SubscribeTopic,
    UnadvertiseTopic,
    UnsubscribeTopic,
    WithdrawService,
)
from appliance.features.doors.door_memory import kept_bytes
from appliance.features.doors.known_types import DoorMessage
from appliance.features.doors.rosbridge_frames import (
    AdvertiseOp,
    AdvertiseServiceOp,
    CallServiceOp,
    Compression,
    OperationError,
    PublishOp,
    ServiceResponseOp,
    SetLevelOp,
    StatusOp,
    SubscribeOp,
    UnadvertiseOp,
    UnadvertiseServiceOp,
    UnsubscribeOp,
    decode_operation,
    id_of,
    json_frame,
    json_of_binary,
    publish_frame,
    type_name,
)
from appliance.features.doors.surroundings import DoorSurroundings
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.errors import PeerError, quote
from roswire.names import resolve
from roswire.xmlrpc import Value

_MAX_TOLD = 100
_WITHOUT_DIGITS = str.maketrans("", "", "0123456789")  # such as the seconds that are left
_LEVELS = ("none", "error", "warning", "info")
_STRENGTH: tuple[Compression, ...] = ("none", "cbor", "cbor-raw")


@dataclass(frozen=True, slots=True)
class RosbridgeLimits:
    """Upper bounds for one connection."""

    topics: int = 1000  # subscriptions and advertisements, by topic
    ids: int = 100  # of one topic
    services: int = 100
    will_bytes: int = 4096
    calls: int = 100  # without an answer, in each direction
    call_seconds: float = 60.0  # unless the client asks for another time
    longest_call_seconds: float = 3600.0


@dataclass(slots=True)
class _Subscription:
    topic: str
    type: str | None = None  # as the first client with a type named it
    clients: dict[ClientId, tuple[float, int, Compression]] = field(default_factory=dict)
    compression: Compression = "none"  # the strongest of all clients
    charged: int = 0


@dataclass(slots=True)
class _Advertisement:
    type: str | None = None
    clients: set[ClientId] = field(default_factory=set)
    will_bytes: int = 0
    charged: int = 0
    refused: AdvertiseTopic | None = None
    """The last advertisement if the door refused it. A message repeats it: most clients advertise only once."""


@dataclass(slots=True)
class _Call:
    service: str  # as the client spells it
    reply_to: ClientId


class Rosbridge:
    """The protocol of one connection; `node` is the name of the door's node."""

    wants_surroundings = False

    def __init__(self, node: str, limits: RosbridgeLimits, queue: ViewerQueue[str]) -> None:
        self.queue = queue
        self._node = node
        self._limits = limits
        self._level = _LEVELS.index("warning")
        self._subscriptions: dict[str, _Subscription] = {}  # by the client's spelling
        self._spellings: dict[str, set[str]] = {}  # of each topic with a subscription
        self._advertised: dict[str, _Advertisement] = {}
        self._services: dict[str, str] = {}  # the client's spelling, by canonical name
        self._calls: dict[int, _Call] = {}
        self._asked: dict[str, str] = {}  # calls to the client: their service, by id
        self._told: dict[str, str] = {}
        self._number = 0
        self._carry_out: dict[type[Any], Callable[[Any], list[DoorRequest]]] = {
            AdvertiseOp: self._advertise,
            UnadvertiseOp: self._unadvertise,
            PublishOp: self._publish,
            SubscribeOp: self._subscribe,
            UnsubscribeOp: self._unsubscribe,
            CallServiceOp: self._call,
            AdvertiseServiceOp: self._offer,
            UnadvertiseServiceOp: self._withdraw,
            ServiceResponseOp: self._answer,
            SetLevelOp: self._set_level,
            StatusOp: lambda _operation: [],
        }

    # --- frames of the client ---

    def receive(self, frame: bytes, *, is_text: bool) -> list[DoorRequest]:
        reply_to: ClientId = None
        text = b""
        try:
            text = frame if is_text else json_of_binary(frame)
            operation = decode_operation(text)
            reply_to = operation.id
            return self._carry_out[type(operation)](operation)
        except PeerError as error:
            self.status("error", str(error), reply_to if reply_to is not None else id_of(text))
            return []

    def _advertise(self, operation: AdvertiseOp) -> list[DoorRequest]:
        topic, size = self._resolve_name(operation.topic), len(bytes(operation.will))
        if size > self._limits.will_bytes:
            raise OperationError(f"the will has {size} bytes; at most {self._limits.will_bytes}")
        kind = type_name(operation.type)
        known = self._add_advertisement(topic, kind, operation.id)
        self._charge(known, size - known.will_bytes)
        known.will_bytes = size
        will = operation.will.copy() if size else None  # not the whole frame
        return [AdvertiseTopic(topic, kind, operation.latch, operation.queue_size or 1, operation.id, will)]

    def _add_advertisement(self, topic: str, kind: str | None, client: ClientId) -> _Advertisement:
        self._check_room(self._advertised, topic, self._limits.topics, "topics are advertised")
        known = self._advertised.setdefault(topic, _Advertisement())
        if known.refused is not None:
            self._charge(known, -known.charged)
            known = self._advertised[topic] = _Advertisement()
        self._name(known, topic, "advertised", kind)
        self._check_room(known.clients, client, self._limits.ids, "advertisements", topic)
        if client not in known.clients:
            known.clients.add(client)
            self._charge(known, kept_bytes(client))
        return known

    def _unadvertise(self, operation: UnadvertiseOp) -> list[DoorRequest]:
        topic = self._resolve_name(operation.topic)
        known = self._advertised.get(topic)
        if known is None:
            return []
        if operation.id in known.clients:
            known.clients.remove(operation.id)
            self._charge(known, -kept_bytes(operation.id))
        if known.clients and operation.id is not None:
            return []
        del self._advertised[topic]
        self._charge(known, -known.charged)
        return [UnadvertiseTopic(topic, operation.id)]

    def _publish(self, operation: PublishOp) -> list[DoorRequest]:
        topic = self._resolve_name(operation.topic)
        publish = PublishMessage(topic, operation.msg, operation.id)
        known = self._advertised.get(topic)
        if known is not None and known.refused is None:
            return [publish]
        if known is not None and known.refused is not None:
            again, known.refused = replace(known.refused, reply_to=operation.id, repeated=True), None
            return [again, publish]
        self._add_advertisement(topic, None, None)
        queue = operation.queue_size or 1
        return [AdvertiseTopic(topic, None, operation.latch, queue, operation.id), publish]

    def _subscribe(self, operation: SubscribeOp) -> list[DoorRequest]:
        topic = self._resolve_name(operation.topic)
        kind = None if operation.type is None else type_name(operation.type)
        self._check_room(self._subscriptions, operation.topic, self._limits.topics, "topics are subscribed")
        subscription = self._subscriptions.setdefault(operation.topic, _Subscription(topic))
        self._name(subscription, topic, "subscribed", kind)
        self._check_room(subscription.clients, operation.id, self._limits.ids, "subscriptions", topic)
        if operation.id not in subscription.clients:
            self._charge(subscription, kept_bytes(operation.id))
        self._spellings.setdefault(topic, set()).add(operation.topic)
        seconds, length = (operation.throttle_rate or 0) / 1000, operation.queue_length or 0
        compression = "none" if operation.compression == "png" else operation.compression
        subscription.clients[operation.id] = seconds, length, compression
        self._configure(operation.topic, subscription)
        if operation.compression == "png":
            text = "a door sends no images of texts: compression png is plain JSON; the smaller form is cbor"
            self._tell(topic, "warning", text, operation.id)
        if operation.fragment_size is not None:
            self._tell(
                topic, "warning", "a door sends no fragments: fragment_size has no effect", operation.id
            )
        return [SubscribeTopic(topic, kind, operation.id)]

    def _configure(self, spelling: str, subscription: _Subscription) -> None:
        """Use the lowest rate, shortest length and strongest compression of all subscriptions, as rosbridge does."""
        seconds = min(client[0] for client in subscription.clients.values())
        length = min(client[1] for client in subscription.clients.values())
        subscription.compression = max((one[2] for one in subscription.clients.values()), key=_STRENGTH.index)
        self.queue.configure(spelling, depth=length or None, interval=seconds)

    def _unsubscribe(self, operation: UnsubscribeOp) -> list[DoorRequest]:
        subscription = self._subscriptions.get(operation.topic)
        if subscription is None:
            return []
        if subscription.clients.pop(operation.id, None) is not None:
            self._charge(subscription, -kept_bytes(operation.id))
        if subscription.clients and operation.id is not None:
            self._configure(operation.topic, subscription)
            return []
        return self._forget_subscription(operation.topic, operation.id)

    def _forget_subscription(self, spelling: str, reply_to: ClientId) -> list[DoorRequest]:
        subscription = self._subscriptions.pop(spelling)
        topic = subscription.topic
        self._charge(subscription, -subscription.charged)
        self.queue.remove(spelling)
        self._spellings[topic].discard(spelling)
        if self._spellings[topic]:
            return []
        del self._spellings[topic]
        return [UnsubscribeTopic(topic, reply_to)]

    def _call(self, operation: CallServiceOp) -> list[DoorRequest]:
        name, _, number = operation.service.partition("#")  # the older notation of the id
        reply_to = operation.id if operation.id is not None or not number else number
        self._number += 1
        call = _Call(operation.service, reply_to)
        if len(self._calls) >= self._limits.calls:
            waiting = counted(len(self._calls), "call of this client waits", "calls of this client wait")
            self._fail_call(call, f"{waiting} for answers; repeat it later")
            return []
        try:
            service = self._resolve_name(name)
        except PeerError as error:
            self._fail_call(call, str(error))
            return []
        self._calls[self._number] = call
        self.queue.memory.keep(kept_bytes(call.service, call.reply_to))
        wished = max(operation.timeout or 0.0, 0.0) or self._limits.call_seconds
        seconds = min(wished, self._limits.longest_call_seconds)
        values = Raw(b"{}") if bytes(operation.args) == b"null" else operation.args
        return [CallOfService(service, self._number, values, seconds, reply_to)]

    def _offer(self, operation: AdvertiseServiceOp) -> list[DoorRequest]:
        service, kind = self._resolve_name(operation.service), type_name(operation.type)
        self._check_room(self._services, service, self._limits.services, "services are offered")
        self._forget_text(self._services, service)
        self._keep_text(self._services, service, operation.service)
        return [OfferService(service, kind, operation.id)]

    def _withdraw(self, operation: UnadvertiseServiceOp) -> list[DoorRequest]:
        service = self._resolve_name(operation.service)
        if self._forget_text(self._services, service) is None:
            raise OperationError(f"this client does not offer the service {quote(operation.service)}")
        for call in [call for call, name in self._asked.items() if name == service]:
            self.give_up(call)
        return [WithdrawService(service, operation.id)]

    def _answer(self, operation: ServiceResponseOp) -> list[DoorRequest]:
        call = operation.id
        service = self._forget_text(self._asked, call) if isinstance(call, str) else None
        if service is None or not isinstance(call, str):
            raise OperationError(f"no call of {quote(operation.service)} has this id")
        return [AnswerCall(service, call, operation.result, operation.values, operation.id)]

    def _set_level(self, operation: SetLevelOp) -> list[DoorRequest]:
        self._level = _LEVELS.index(operation.level)
        return []

    # --- tables ---

    def _check_room(self, table: Collection[Any], key: object, most: int, what: str, topic: str = "") -> None:
        if key in table:
            return
        if len(table) >= most:
            used = f"{topic} has {len(table)} {what}" if topic else f"{len(table)} {what} by this client"
            raise OperationError(f"{used}; at most {most}")
        if reason := self.queue.memory.refusal_to_keep():
            raise OperationError(reason)

    def _name(self, known: _Subscription | _Advertisement, topic: str, use: str, kind: str | None) -> None:
        if None not in (known.type, kind) and known.type != kind:
            raise OperationError(f"{topic} is {use} as {known.type}, not {kind}")
        if not known.charged:
            self._charge(known, kept_bytes(topic))
        if known.type is None and kind is not None:
            known.type = kind
            self._charge(known, kept_bytes(kind))

    def _charge(self, known: _Subscription | _Advertisement, size: int) -> None:
        known.charged += size
        self.queue.memory.keep(size)

    def _keep_text(self, table: dict[str, str], key: str, text: str) -> None:
        table[key] = text
        self.queue.memory.keep(kept_bytes(key, text))

    def _forget_text(self, table: dict[str, str], key: str) -> str | None:
        text = table.pop(key, None)
        if text is not None:
            self.queue.memory.keep(-kept_bytes(key, text))
        return text

    def _end_call(self, number: int) -> _Call | None:
        call = self._calls.pop(number, None)
        if call is not None:
            self.queue.memory.keep(-kept_bytes(call.service, call.reply_to))
        return call

    def _resolve_name(self, name: str) -> str:
        return resolve(name, self._node)

    # --- answers and refusals ---

    def failed(self, request: DoorRequest, reason: str) -> None:
        match request:
            case CallOfService():
                if call := self._end_call(request.call):
                    self._fail_call(call, reason)
                return
            case AdvertiseTopic():
                if request.topic in self._advertised:
                    self._advertised[request.topic].refused = request
            case SubscribeTopic():
                for spelling in [
                    key for key, one in self._subscriptions.items() if one.topic == request.topic
                ]:
                    self._forget_subscription(spelling, None)
            case OfferService():
                self._forget_text(self._services, request.service)
        if isinstance(request, AdvertiseTopic | PublishMessage | SubscribeTopic):
            self._tell(request.topic, "error", reason, request.reply_to)
        else:
            self.status("error", reason, request.reply_to)

    def _tell(self, topic: str, level: str, reason: str, reply_to: ClientId) -> None:
        self.status(level, reason, reply_to)
        # roslib shows a program only statuses without an id. Once for each topic and reason, it gets this one too.
        told = f"{topic} {reason.translate(_WITHOUT_DIGITS)}"
        if reply_to is not None and told not in self._told and len(self._told) < _MAX_TOLD:
            self._keep_text(self._told, told, "")
            self.status(level, reason)

    def _fail_call(self, call: _Call, reason: str) -> None:
        # ros-mcp takes values without `successful` for a success.
        fields = {
            "op": "service_response",
            "service": call.service,
            "values": {"message": reason, "successful": False, "reason": reason},
            "result": False,
        }
        self.queue.reply(json_frame(fields, call.reply_to))

    def answered(self, number: int, values: Raw | bytes) -> None:
        if call := self._end_call(number):
            fields = {"op": "service_response", "service": call.service, "values": values, "result": True}
            self.queue.reply(json_frame(fields, call.reply_to))

    def warned(self, reason: str) -> None:
        self.status("error", reason)

    def parameters(self, _values: Mapping[str, object], _reply_to: str | None) -> None: ...

    def parameter_changed(self, _subscribed: str, _name: str, _value: Value, _now: float) -> None: ...

    def surroundings(self, _seen: DoorSurroundings) -> list[DoorRequest]:
        return []

    def ask(self, service: str, values: Raw) -> str:
        spelling = self._services.get(service)
        if spelling is None:
            raise OperationError(f"the client does not offer {service} any longer")
        if len(self._asked) >= self._limits.calls:
            raise OperationError(f"the client has not answered {counted(len(self._asked), 'call')}")
        self._number += 1
        call = f"service_request:{spelling}:{self._number}"
        self._keep_text(self._asked, call, service)
        self.queue.reply(json_frame({"op": "call_service", "service": spelling, "args": values}, call))
        return call

    def give_up(self, call: str) -> None:
        self._forget_text(self._asked, call)

    def status(self, level: str, text: str, reply_to: ClientId = None) -> None:
        if _LEVELS.index(level) <= self._level:
            self.queue.reply(json_frame({"op": "status", "level": level, "msg": text}, reply_to))

    # --- messages of topics ---

    def message(self, message: DoorMessage, now: float) -> None:
        for spelling in self._spellings.get(message.topic, ()):
            self.queue.put(spelling, message, len(message.body), now)

    def next_frame(self, now: float) -> ClientFrame | None:
        taken = self.queue.take(now)
        if taken is None or taken[0] is None:
            return None if taken is None else taken[1]
        spelling, message = taken
        try:
            compression = self._subscriptions[spelling].compression
            frame: ClientFrame = message.frame((spelling, compression), publish_frame)
            # A raw message had room while it waited; what is made of one can be many times as large.
            if compression != "cbor-raw":
                more = max(frame_size(frame) - len(message.body), 0)
                self.queue.memory.take(more)
                self.queue.memory.send(more)
            return frame
        except PeerError as error:  # there is no room, or the message does not fit its definition
            return json_frame({"op": "status", "level": "error", "msg": f"{spelling}: {error}"})

    def next_time(self) -> float | None:
        return self.queue.next_time()
