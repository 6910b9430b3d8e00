"""The node of a door, which all connections of its identity share.

Agents make a new connection for each call, so a topic stays registered for some seconds after its last client has
left, unless a new topic needs its slot. The master and the relay decide about a door as about any host.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from typing import Protocol
from weakref import WeakValueDictionary

import msgspec
from msgspec import Raw

from appliance.base import clock
from appliance.base.counted import counted
from appliance.features.doors.client_requests import (
    AdvertiseTopic,
    AnswerCall,
    CallOfService,
    DoorRequest,
    OfferService,
    PublishMessage,
    ReadParameters,
    SubscribeParameter,
    SubscribeTopic,
    UnadvertiseTopic,
    UnsubscribeParameter,
    UnsubscribeTopic,
    WithdrawService,
    WriteParameter,
)
from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.door_parameters import TOO_MANY_CALLS, DoorParameters, ParameterClient
from appliance.features.doors.heard_topic import HeardTopic, one_type, two_types
from appliance.features.doors.host_shares import check_share, of_hosts
from appliance.features.doors.known_types import DoorMessage, KnownType, KnownTypes, SharedFrames, TypeKey
from appliance.features.doors.lookout import HostsOf
from appliance.features.doors.message_writer import MessageWriter, Now
from appliance.features.doors.node_hosts import ROBOT
from appliance.features.doors.quotas import DOOR_CALLS, DOOR_SERVICES, DOOR_TOPICS
from appliance.rpc.processor_time import ProcessorTime
from roswire.errors import DefinitionError, LimitExceededError, PeerError, ProtocolError, RosError
from roswire.node import (
    MasterDenialError,
    MessageType,
    NodePublication,
    RosNode,
    ServiceFailedError,
    ServiceType,
)
from roswire.node.network import OwnedTasks, PeerUnreachableError
from roswire.node.tcpros_streams import ANY
from roswire.tcpros import Body

# End topics some seconds after their last client has left, unless a client comes back.


class Lingering:
    """Calls `end(topic)` `seconds` after `left(topic)`, unless `used(topic)` comes first. All share one timer."""

    def __init__(self, seconds: float, end: Callable[[str], object]) -> None:
        self._seconds = seconds
        self._end = end
        self._ends: dict[str, float] = {}  # the first to end first
        self._timer: asyncio.TimerHandle | None = None

    def left(self, topic: str) -> None:
        self.used(topic)
        self._ends[topic] = asyncio.get_running_loop().time() + self._seconds
        if self._timer is None:
            self._start()

    def used(self, topic: str) -> None:
        self._ends.pop(topic, None)

    def pop(self) -> str | None:
        """Return the topic that would end first, which the caller ends."""
        topic = next(iter(self._ends), None)
        if topic is not None:
            del self._ends[topic]
        return topic

    def close(self) -> None:
        self._ends.clear()
        if self._timer is not None:
            self._timer.cancel()

    def _start(self) -> None:
        first = next(iter(self._ends.values()))
        self._timer = asyncio.get_running_loop().call_at(first, self._ring)

    def _ring(self) -> None:
        self._timer = None
        now = asyncio.get_running_loop().time()
        while self._ends:
            topic, when = next(iter(self._ends.items()))
            if when > now:
                self._start()
                return
            del self._ends[topic]
            self._end(topic)


_SMALL_BYTES = 1 << 16
"""A message of up to this size, such as a stop, is written even if the memory is in use."""

_LINGER_SECONDS = 10.0
_REPLAY_SECONDS = 1.0  # not longer: an old command must not reach a robot
_LEARN_SECONDS = 1.0
_ASK_SECONDS, _ASK_AGAIN_SECONDS = 1.0, 10.0
_ANSWER_SECONDS = (
    60.0  # of a call, unless the client asks for another time; also of a call to a client's service
)
_LEFT_SECONDS = 10.0  # in which calls of a client end that has left

BuiltIn = Callable[[CallOfService], "Awaitable[Raw] | None"]
"""Answers a call of a service that the door itself has; returns None for other services."""


class _Subscriber(Protocol):
    @property
    def memory(self) -> ClientMemory:
        """Return the memory that is charged for the connection's requests."""

    def heard(self, message: DoorMessage, now: float) -> None: ...

    def failed(self, request: DoorRequest, reason: str) -> None: ...

    def warned(self, reason: str) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class _Learner:
    memory: ClientMemory

    def heard(self, message: DoorMessage, now: float) -> None: ...

    def failed(self, request: DoorRequest, reason: str) -> None: ...

    def warned(self, reason: str) -> None: ...


class DoorClient(_Subscriber, ParameterClient, Protocol):
    """A connection, as the node uses it."""

    def answered(self, call: int, values: Raw | bytes) -> None: ...

    def ask(self, service: str, values: Raw) -> str:
        """Forward a call of an offered service, and return its id."""

    def give_up(self, call: str) -> None: ...


@dataclass(slots=True)
class _Publication:
    publication: NodePublication
    request: AdvertiseTopic
    type: KnownType
    asked: float
    """The time when the master was last asked whether it grants the publication."""
    doubtful: bool = False
    """Whether subscribers of the publication have left since then, or the master refused it."""
    refusal: RosError | None = None
    learner: _Learner | None = None
    """The subscriber that hears the publishers which define the type; None if ROS or the operator defines it."""
    agreed: Sequence[Mapping[str, str]] = ()
    """The headers of the publishers that were last compared with the type."""
    heard: float = field(default_factory=clock.now)
    """The time when such a publisher was last present."""
    clients: set[DoorClient] = field(default_factory=set)
    wills: dict[DoorClient, Raw] = field(default_factory=dict)

    def publish(self, values: Raw | bytes, memory: ClientMemory) -> None:
        raw = isinstance(values, Raw)
        self.publication.publish(_write(self.type.codec.writer, values, memory) if raw else values)


@dataclass(slots=True)
class _Offer:
    client: DoorClient
    response: KnownType
    calls: dict[str, asyncio.Future[bytes]] = field(default_factory=dict)


class DoorNode:
    """Carries out the requests of all connections of one door."""

    def __init__(
        self,
        node: RosNode,
        types: KnownTypes,
        built_in: BuiltIn,
        *,
        most_topics: int,
        calls: ClientMemory,  # charged with arguments of calls, which may outlive their connection
        hosts: HostsOf,
    ) -> None:
        self.node = node
        self.time = ProcessorTime(lambda host: host)
        self._hosts = hosts
        self._topics = DOOR_TOPICS.bounds.resize(most_topics)
        self._calls = calls
        self.waiting_calls = of_hosts("calls of this door that wait for answers", DOOR_CALLS.bounds.whole)
        self._types = types
        self._built_in = built_in
        self._publications: dict[str, _Publication] = {}
        self._heard: dict[str, HeardTopic[_Subscriber]] = {}
        self._offers: dict[str, _Offer] = {}
        self._refused: dict[str, tuple[float, str | None, str]] = {}  # when, type and reason, by topic
        self._calls_of: dict[DoorClient, set[asyncio.Timeout]] = {}
        self._parameters = DoorParameters(node, calls)
        self._frames = SharedFrames()
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._tasks = OwnedTasks()
        self._published = Lingering(
            _LINGER_SECONDS, lambda topic: self._tasks.start(self._end_publication(topic))
        )
        self._subscribed = Lingering(
            _LINGER_SECONDS, lambda topic: self._tasks.start(self._end_subscription(topic))
        )

    async def close(self) -> None:
        self._published.close()
        self._subscribed.close()
        await self._tasks.close()
        await self._parameters.close()
        await self.node.close()

    async def carry_out(self, request: DoorRequest, client: DoorClient) -> None:
        match request:
            case AdvertiseTopic():
                await self._advertise(request, client)
            case UnadvertiseTopic(topic):
                self._unadvertise(topic, client)
            case PublishMessage():
                await self._publish(request, client)
            case SubscribeTopic():
                await self._subscribe(request, client)
            case UnsubscribeTopic(topic):
                self._unsubscribe(topic, client)
            case CallOfService():
                self._begin_call(request, client)
            case OfferService():
                await self._offer(request, client)
            case WithdrawService(service):
                await self._withdraw(service)
            case AnswerCall():
                self._answer(request, client)
            case ReadParameters():
                self._parameters.begin_read(request, client)
            case WriteParameter():
                await self._parameters.write(request)
            case SubscribeParameter() | UnsubscribeParameter():
                await self._parameters.carry_out(request, client)

    async def forget(self, client: DoorClient, *, wills: bool) -> None:
        """Release all that a connection used, and publish its wills, unless its right has ended."""
        for topic, known in [
            (topic, one) for topic, one in self._publications.items() if client in one.clients
        ]:
            if client in known.wills and wills:
                # Its subscribers would not get it if there is no memory, or if the right to publish has ended.
                with contextlib.suppress(LimitExceededError, RosError):
                    await self._check_granted(known)
                    if await self._check_type(known):
                        known.publish(known.wills[client], client.memory)
            self._unadvertise(topic, client)
        for topic in [topic for topic, heard in self._heard.items() if client in heard.clients]:
            self._unsubscribe(topic, client)
        for service in [service for service, offer in self._offers.items() if offer.client is client]:
            await self._withdraw(service)
        self._parameters.forget(client)
        now = asyncio.get_running_loop().time()
        for limit in self._calls_of.pop(client, ()):
            limit.reschedule(now + _LEFT_SECONDS)

    def policy_changed(self) -> None:
        """Ask the master again before another client shares a subscription: the door's right may have ended."""
        for heard in self._heard.values():
            heard.doubtful = True
        self._parameters.policy_changed()

    # --- publications ---

    async def _advertise(self, request: AdvertiseTopic, client: DoorClient) -> None:
        refused = self._refused.get(request.topic) if request.repeated else None
        if refused is not None and clock.now() - refused[0] < _ASK_SECONDS and refused[1] == request.type:
            raise ProtocolError(refused[2])
        await self._register(request, client)
        self._refused.pop(request.topic, None)

    @contextlib.contextmanager
    def _refusing_all(self, request: AdvertiseTopic) -> Iterator[None]:
        """Remember a refusal that every client of the door would get, unlike one of a will or of a host's share."""
        try:
            yield
        except RosError as error:
            if len(self._refused) >= self._topics.whole:
                self._refused.clear()
            self._refused[request.topic] = clock.now(), request.type, str(error)
            raise

    async def _register(self, request: AdvertiseTopic, client: DoorClient) -> None:
        async with self._lock(f"publisher {request.topic}"):
            known = self._publications.get(request.topic)
            if known is not None and not known.clients and not self._fits(known, request):
                await self._drop(request.topic)
                known = None
            if known is not None and (objection := await self._objection(known)):
                await self._drop(request.topic, objection)
                known = None
            if known is None:
                users = [one.clients for one in self._publications.values()]
                await self._make_room(
                    self._publications, users, client, self._published, self._end_publication
                )
                learner = _Learner(self._calls)
                try:
                    with self._refusing_all(request):
                        kind = await self._published_type(request, learner)
                    _check_will(request, kind, client.memory)
                    with self._refusing_all(request):
                        publication = await self.node.advertise(
                            request.topic,
                            MessageType.of(kind.definitions, kind.name),
                            latched=request.latched,
                            queue=request.queue,
                            replay=_REPLAY_SECONDS,
                        )
                except BaseException:
                    self._unsubscribe(request.topic, learner)
                    raise
                known = self._publications[request.topic] = _Publication(
                    publication, request, kind, clock.now(), learner=None if kind.defined else learner
                )
                if kind.defined:
                    self._unsubscribe(request.topic, learner)
            elif request.type not in (None, known.publication.type.name):
                raise ProtocolError(
                    f"{request.topic} is advertised as {known.publication.type.name}, not {request.type}"
                )
            else:
                _check_will(request, known.type, client.memory)
            if request.will is not None:
                known.wills[client] = request.will
            known.clients.add(client)
            self._published.used(request.topic)

    def _fits(self, known: _Publication, request: AdvertiseTopic) -> bool:
        """Return whether a publication that no client uses serves this advertisement.

        The publisher that defined its type may be gone, or the operator's file has changed.
        """
        defined = known.type.defined and self._types.defines(known.type.key)
        given = known.type.name, known.publication.latched
        return defined and (request.type is None or (request.type, request.latched) == given)

    async def _published_type(self, request: AdvertiseTopic, learner: _Learner) -> KnownType:
        """Return the type as ROS or the operator define it, or else as the publishers of this topic do."""
        name = request.type or await self._type_of(request.topic)
        if self._types.has_message(name):
            return self._types.message(name)
        headers = await self._counting(await self._headers(request.topic, learner))
        return one_type(request.topic, headers, self._types, name)

    async def _counting(self, headers: list[Mapping[str, str]]) -> list[Mapping[str, str]]:
        """Return the headers that count for the type of a topic: if they differ, the defined or the robot's own."""
        keys = [self._types.key(header) for header in headers]
        if len({*keys}) <= 1:
            return headers
        defined = [header for key, header in zip(keys, headers, strict=True) if self._types.defines(key)]
        return defined or await self._of_robot(headers) or headers

    async def _of_robot(self, headers: Collection[Mapping[str, str]]) -> list[Mapping[str, str]]:
        hosts = await self._hosts({header.get("callerid", "") for header in headers})
        return [header for header in headers if hosts.get(header.get("callerid", "")) == ROBOT]

    async def _check_type(self, known: _Publication) -> bool:
        """Return whether the publication has the type of its topic; if not, end it and tell its clients."""
        objection = await self._objection(known)
        if objection:
            topic = known.publication.topic
            async with self._lock(f"publisher {topic}"):
                if self._publications.get(topic) is known:
                    await self._drop(topic, objection)
        return not objection

    async def _objection(self, known: _Publication) -> str:
        """Return why the publication has not the type of its topic any more, or an empty text.

        A type that ROS or the operator defines stays. Another one ends with the publishers that define it so.
        """
        topic = known.publication.topic
        if known.learner is None:
            return ""
        subscription = self.node.subscribers.get(topic)
        headers = [] if subscription is None else [*subscription.connected.values()]
        if headers and [*map(id, headers)] == [*map(id, known.agreed)]:
            known.heard = clock.now()
        elif headers:
            keys = {self._types.key(header) for header in await self._counting(headers)}
            if keys != {known.type.key}:
                return two_types(topic, next(iter(keys - {known.type.key})), known.type.key)
            known.agreed, known.heard = headers, clock.now()
        elif clock.now() - known.heard > _LINGER_SECONDS:
            return (
                f"the publishers of {topic} that define its type are gone, so the door does not know it any longer; put"
                " its .msg file in msg/PACKAGE of the folder of specifications (rosrv monitor reload)"
            )
        return ""

    async def _drop(self, topic: str, reason: str = "") -> None:
        known = self._publications.pop(topic)
        for client in known.clients if reason else ():
            again = replace(known.request, reply_to=None, will=known.wills.get(client))
            client.failed(again, reason)  # its protocol repeats the request with its next message
        if known.learner is not None:
            self._unsubscribe(topic, known.learner)
        await self.node.unadvertise(topic)

    async def _type_of(self, topic: str) -> str:
        try:
            types = await self.node.master("getTopicTypes")
        except MasterDenialError as denial:
            raise ProtocolError(
                f"advertise {topic} with its type; the door cannot look it up: {denial}"
            ) from None
        for row in types if isinstance(types, list) else []:
            match row:
                case [str(name), str(kind)] if name == topic and kind != ANY:
                    return kind
        raise ProtocolError(f"the type of {topic} is not known; advertise it with its type first")

    def _unadvertise(self, topic: str, client: DoorClient) -> None:
        known = self._publications.get(topic)
        if known is not None and client in known.clients:
            known.clients.remove(client)
            known.wills.pop(client, None)
            if not known.clients:
                self._published.left(topic)

    async def _end_publication(self, topic: str) -> None:
        async with self._lock(f"publisher {topic}"):
            known = self._publications.get(topic)
            if known is not None and not known.clients:
                await self._drop(topic)

    async def _publish(self, request: PublishMessage, client: DoorClient) -> None:
        known = self._publications.get(request.topic)
        if known is None:
            raise ProtocolError(f"{request.topic} is not advertised by this client")
        await self._check_granted(known)
        if await self._check_type(known):
            known.publish(request.values, client.memory)

    async def _check_granted(self, known: _Publication) -> None:
        """Raise the master's refusal if the publication is no longer granted, for example after an approval ended.

        The master does not notify publishers, so it is asked again soon after the last subscriber left.

        """
        if known.publication.subscribers:
            known.doubtful, known.refusal = True, None
        elif clock.now() - known.asked >= (_ASK_SECONDS if known.doubtful else _ASK_AGAIN_SECONDS):
            known.asked, before = clock.now(), known.refusal
            try:
                await self.node.advertise_again(known.publication.topic)
                known.doubtful, known.refusal = False, None
            except MasterDenialError as denial:
                known.doubtful, known.refusal = True, denial
            if before is not None and known.refusal is None:
                known.publication.replay_from_now()
        if known.refusal is not None:
            raise known.refusal

    # --- subscriptions ---

    async def _subscribe(self, request: SubscribeTopic, client: _Subscriber) -> None:
        topic = request.topic
        async with self._lock(f"subscriber {topic}"):
            if topic in self._heard:
                try:
                    await self._check_subscribed(topic)
                except RosError:
                    self._unsubscribe(topic, client)  # its protocol forgets the topic
                    raise
                heard = self._heard[topic]
                heard.clients[client] = request
                self._subscribed.used(topic)
                for key in {*heard.told} & {*self._present(topic)}:
                    client.warned(heard.told[key])
                self.node.repeat(topic, lambda body, header: self._hear(topic, body, header, [client]))
                return
            users = [one.clients for one in self._heard.values()]
            await self._make_room(self._heard, users, client, self._subscribed, self._end_subscription)
            self._heard[topic] = HeardTopic(topic, self._types, {client: request})
            try:
                await self.node.subscribe(
                    topic,
                    lambda body, header: self._hear(topic, body, header),
                    MessageType(request.type or ANY, ANY, ""),
                )
            except BaseException:
                del self._heard[topic]
                raise

    async def _check_subscribed(self, topic: str) -> None:
        """Raise the master's refusal if the subscription, which another client shares, is no longer granted."""
        heard = self._heard[topic]
        if not heard.doubtful:
            return
        try:
            await self.node.subscribe_again(topic)
        except MasterDenialError as denial:
            for client in heard.clients:
                client.warned(str(denial))
            raise
        heard.doubtful = False

    def _hear(
        self,
        topic: str,
        body: Body,
        header: Mapping[str, str],
        receivers: Iterable[_Subscriber] | None = None,
    ) -> None:
        heard = self._heard.get(topic)
        if heard is None:
            return
        if heard.header is not header and (reason := heard.refusal(header, lambda: self._present(topic))):
            if heard.tells(header, reason):
                for client in heard.clients:
                    client.warned(reason)
                self._tasks.start(self._prefer_robot(heard, header))
            return
        clients, kind = heard.clients, header.get("type", ANY)
        shared = self._frames if receivers is None and len(clients) > 1 else None
        message = DoorMessage(topic, body, header, clock.wall_ns(), heard.known_type, shared)
        now = asyncio.get_running_loop().time()
        wrong = []
        for client in clients if receivers is None else receivers:
            request = clients.get(client)
            if request is not None and request.type in (None, kind):
                client.heard(message, now)
            elif request is not None:
                wrong.append((client, request))
        for client, request in wrong:
            self._unsubscribe(topic, client)
            client.failed(request, f"{topic} has the type {kind[:200]}, not {request.type}")

    def _present(self, topic: str) -> list[TypeKey]:
        """Return the types of the present publishers of a topic, also of this node."""
        subscription, own = self.node.subscribers.get(topic), self._publications.get(topic)
        headers = [] if subscription is None else subscription.connected.values()
        present = [self._types.key(header) for header in headers]
        return present if own is None else [*present, own.type.key]

    async def _prefer_robot(self, heard: HeardTopic[_Subscriber], header: Mapping[str, str]) -> None:
        """Take this header's type if its publisher, but not that of the present type, is on the robot's machine."""
        counts = heard.header
        if counts is None or self._types.defines(self._types.key(counts)):
            return
        if [*await self._of_robot([counts, header])] == [header] and heard.header is counts:
            heard.put_first(header)
            heard.told = {
                self._types.key(counts): two_types(heard.topic, *map(self._types.key, (header, counts)))
            }
            for client in heard.clients:
                client.warned(heard.told[self._types.key(counts)])

    def heard_type(self, topic: str) -> KnownType | None:
        """Return the type that counts on a topic to which the door subscribes, or None if there is none."""
        heard = self._heard.get(topic)
        if heard is None or heard.header is None or self._types.key(heard.header) not in self._present(topic):
            return None
        try:
            return heard.known_type(heard.header)
        except DefinitionError:
            return None

    def _unsubscribe(self, topic: str, client: _Subscriber) -> None:
        heard = self._heard.get(topic)
        if heard is not None and heard.clients.pop(client, None) is not None and not heard.clients:
            self._subscribed.left(topic)

    async def _end_subscription(self, topic: str) -> None:
        async with self._lock(f"subscriber {topic}"):
            if topic in self._heard and not self._heard[topic].clients:
                del self._heard[topic]
                await self.node.unsubscribe(topic)

    # --- services ---

    def _begin_call(self, request: CallOfService, client: DoorClient) -> None:
        given = request.values
        values = given.copy() if isinstance(given, Raw) else given  # not the whole frame
        size = memoryview(values).nbytes
        if reason := self.waiting_calls.refusal(client.memory.host):
            raise LimitExceededError(TOO_MANY_CALLS + reason)
        self._calls.take(size, TOO_MANY_CALLS)
        self.waiting_calls.charge(client.memory.host)
        self._tasks.start(self._call(replace(request, values=values), client, size))

    async def _call(self, request: CallOfService, client: DoorClient, size: int) -> None:
        seconds = request.seconds or _ANSWER_SECONDS
        limit = asyncio.timeout(seconds)
        self._calls_of.setdefault(client, set()).add(limit)
        try:
            async with limit:
                own = self._built_in(request)
                answer = await (self._call_node(request, seconds) if own is None else own)
            client.answered(request.call, answer)
        except TimeoutError:
            client.failed(request, f"{request.service} did not answer within {seconds:g} s")
        except RosError as error:
            client.failed(request, str(error))
        finally:
            if client in self._calls_of:
                self._calls_of[client].discard(limit)
                if not self._calls_of[client]:
                    del self._calls_of[client]
            self._calls.add(-size)
            self.waiting_calls.give_back(client.memory.host)

    async def _call_node(self, request: CallOfService, seconds: float) -> Raw | bytes:
        header = await self.node.probe_service(request.service)
        name, md5sum = header.get("type", ""), header.get("md5sum", "*")
        if request.type not in (None, name):
            raise ProtocolError(f"{request.service} has the type {name[:200]}, not {request.type}")
        sent, received, definitions = self._types.service(name)
        if definitions.service_md5sum(name) != md5sum:
            raise DefinitionError(f"{request.service} has another version of this type", name[:200])
        if not isinstance(request.values, Raw):
            return await self.node.call_service(request.service, md5sum, request.values, seconds)
        writer = sent.codec.writer
        body = _write(writer, _by_name(request.values, writer.fields), self._calls)
        return received.codec.json(await self.node.call_service(request.service, md5sum, body, seconds))

    async def _offer(self, request: OfferService, client: DoorClient) -> None:
        known = self._offers.get(request.service)
        if known is not None and known.client is client:  # as in rosbridge, the newer offer replaces it
            await self._withdraw(request.service)
        elif known is not None:
            raise ProtocolError(f"{request.service} is already offered by a client of this door")
        check_share("services", DOOR_SERVICES.bounds, [{o.client} for o in self._offers.values()], client)
        given, response, definitions = self._types.service(request.type)
        offer = self._offers[request.service] = _Offer(client, response)

        async def answer(body: bytes) -> bytes:
            call = client.ask(request.service, given.codec.json(body))
            future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
            offer.calls[call] = future
            try:
                async with asyncio.timeout(_ANSWER_SECONDS):
                    return await future
            except TimeoutError:
                raise ServiceFailedError(f"the client did not answer within {_ANSWER_SECONDS:g} s") from None
            finally:
                del offer.calls[call]
                client.give_up(call)

        try:
            await self.node.offer(request.service, ServiceType.of(definitions, request.type), answer)
        except BaseException:
            del self._offers[request.service]
            raise

    async def _withdraw(self, service: str) -> None:
        offer = self._offers.pop(service, None)
        if offer is not None:
            for future in offer.calls.values():
                if not future.done():
                    future.set_exception(ServiceFailedError("the client offers the service no longer"))
            await self.node.withdraw(service)

    def _answer(self, request: AnswerCall, client: DoorClient) -> None:
        offer = self._offers.get(request.service)
        future = offer.calls.get(request.call) if offer is not None else None
        if offer is None or future is None or future.done():
            raise ProtocolError(f"no call of {request.service} waits for this answer")
        try:
            # As in rosbridge, values that fit are the answer, whatever `result` is: some clients send false.
            future.set_result(_write(offer.response.codec.writer, request.values, client.memory))
        except PeerError as error:
            reason = str(error) if request.ok else bytes(request.values)[:1000].decode("utf-8", "replace")
            future.set_exception(ServiceFailedError(reason))
            if request.ok:
                raise

    async def learn(self, topic: str) -> KnownType:
        """Return the type of a topic, from its publishers. Raise `RosError` if none of them answers or can be used."""
        learner = _Learner(self._calls)
        try:
            headers = await self._headers(topic, learner)
        finally:
            self._unsubscribe(topic, learner)
        if not headers:
            raise PeerUnreachableError(f"no publisher of {topic} answers")
        return self._types.learn((await self._counting(headers))[0])

    async def _headers(self, topic: str, learner: _Learner) -> list[Mapping[str, str]]:
        """Subscribe, and return the headers of the publishers of a topic, after at most a second."""
        await self._subscribe(SubscribeTopic(topic), learner)
        return await self.node.subscribers[topic].headers(_LEARN_SECONDS)

    async def _make_room(
        self,
        topics: Sized,
        users: Iterable[Collection[_Subscriber]],
        client: _Subscriber,
        unused: Lingering,
        end: Callable[[str], Awaitable[None]],
    ) -> None:
        """A topic without a client ends early if a new one needs its slot."""
        check_share("topics", self._topics, [clients for clients in users if clients], client)
        while len(topics) >= self._topics.whole and (topic := unused.pop()) is not None:
            await end(topic)

    def _lock(self, name: str) -> asyncio.Lock:
        lock = self._locks.get(name) or asyncio.Lock()
        self._locks[name] = lock
        return lock


def _write(writer: MessageWriter, values: Raw | bytes, memory: ClientMemory) -> bytes:
    cost = writer.cost(values)
    with memory.holding(cost) if cost > _SMALL_BYTES else contextlib.nullcontext():
        return writer.from_json(values, present_time())


def _check_will(request: AdvertiseTopic, kind: KnownType, memory: ClientMemory) -> None:
    if request.will is not None:
        _write(kind.codec.writer, request.will, memory)  # raises if it does not fit


def _by_name(values: Raw, names: list[str]) -> bytes:
    """Return the arguments by name. A client may give them as a list in the order of the fields."""
    text = bytes(values)
    if not text.lstrip().startswith(b"["):
        return text
    given = msgspec.json.decode(text, type=list[Raw])
    if len(given) > len(names):
        raise ProtocolError(
            f"{counted(len(given), 'argument')}; the request has {counted(len(names), 'field')}: {', '.join(names)}"
        )
    return msgspec.json.encode(dict(zip(names, given, strict=False)))


def present_time() -> Now:
    seconds, nanoseconds = divmod(clock.wall_ns(), 1_000_000_000)
    return seconds, nanoseconds
