"""The WebSocket of one client: handshake, frames in both directions, and the end.

1. A frame is at most `frame_bytes` long, even after inflation. A browser's Origin must be allowed (`origins.py`).
2. The client's requests are carried out in order; calls of services and reads of parameters do not hold up later
   ones.
3. Frames are sent only as fast as the client reads. In the meantime, its queue keeps the newest messages of each
   topic, and its requests are carried out: a stop does not wait for images.
4. A client that sends nothing, and does not answer pings, is disconnected; this happens within seconds if it has a
   will, which the door then publishes.
5. Once the session disconnects a client, it carries out no more requests, and drops the frames that the client does
   not take.
6. A client that holds memory which all clients share (`door_memory.py`) must take frames: `_LEAST_TAKEN` bytes in
   `_TAKING_SECONDS`. Otherwise it is disconnected, because large messages for other clients may find no space.
7. The hosts of the clients share the processor: a host waits for one frame of the others, not for all that have come.
8. A client must finish what it has begun (`door_memory.py`), even if it answers pings. Its handshake takes at most
   `handshake_seconds`.
"""

import asyncio
import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from typing import Protocol

from msgspec import Raw
from websockets.exceptions import ProtocolError as WebSocketError
from websockets.extensions.permessage_deflate import ServerPerMessageDeflateFactory
from websockets.frames import CloseCode, Opcode
from websockets.frames import Frame as WebSocketFrame
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.typing import Subprotocol

from appliance.features.doors.client_frames import ClientFrame, content, frame_size, is_text
from appliance.features.doors.client_requests import (
    AdvertiseTopic,
    CallOfService,
    DoorRequest,
    PublishMessage,
    UnadvertiseTopic,
)
from appliance.features.doors.connections import ClientWriter
from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.door_node import DoorNode
from appliance.features.doors.known_types import DoorMessage
from appliance.features.doors.lookout import Lookout
from appliance.features.doors.origins import rejection
from appliance.features.doors.surroundings import DoorSurroundings
from appliance.features.doors.viewer_queue import ViewerStalledError
from appliance.rpc.processor_time import TURN_SECONDS, HostTask
from roswire.errors import LimitExceededError, ProtocolError, RosError
from roswire.tcpros import Body
from roswire.xmlrpc import Value

# Count the refusals of the topics of one client, to disconnect a program that does not read them. No I/O, no clock.
#
# Some libraries show a program no `status`, so it would go on for hours without an effect. They show the reason of a
# closing frame. A call that waits for an approval is repeated until the operator answers, so it does not count, and no
# client is disconnected while one of its calls waits.

MAX_REFUSALS = 100
REFUSAL_SECONDS = 30.0
HELD = "held for approval"
"""A call with these words in its reason waits for an operator."""
_HELD_SECONDS = 120.0  # as long as a held call waits
_MAX_TOPICS = 100


class RefusalCounts:
    """The refusals of one client. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {}
        self._held_until = 0.0

    def count_refusal(self, topic: str, reason: str, now: float) -> bool:
        """Count a refusal of a topic (empty: of a call). Return whether the client must be disconnected."""
        if HELD in reason:
            self._held_until = now + _HELD_SECONDS
            return False
        if not topic:
            return False
        if topic not in self._times and len(self._times) >= _MAX_TOPICS:
            self._times.clear()
        times = self._times.setdefault(topic, deque(maxlen=MAX_REFUSALS))
        times.append(now)
        return len(times) == MAX_REFUSALS and now - times[0] <= REFUSAL_SECONDS and now >= self._held_until


_READ_BYTES = 1 << 16
_READ_DEFLATED_BYTES = 1 << 12  # the frames that are read at once take up to 1000 times as much inflated
_BATCH_BYTES = 1 << 15
_COPIES = 2  # of a frame while it is carried out: itself, and its operation
_TAKING_SECONDS = 5.0
_LEAST_TAKEN = 1 << 19
_CLOSING_SECONDS = 2.0
_CLOSE_BYTES = 120  # of the reason in a closing frame
_LAST_SECONDS = 1.0  # in which the client may take the last frames
_LAST_TURN_SECONDS = 0.05
_WATCH_SECONDS = 2.0  # between two looks at the surroundings
_MAX_PINGS = 100  # of the client that wait for their answers
_WINDOW_BITS = 12  # with this and the level, a connection takes about 40 KB for compression


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """The limits of a connection in bytes and seconds."""

    origins: tuple[str, ...] = ()
    frame_bytes: int = 8 << 20
    handshake_seconds: float = 10.0
    ping_seconds: float = 20.0
    silent_seconds: float = 60.0
    will_ping_seconds: float = 1.0  # of a client with a will
    will_silent_seconds: float = 3.0


class ClientProtocol(Protocol):
    """The protocol that a client speaks, without I/O. Methods may raise `ViewerStalledError`."""

    @property
    def wants_surroundings(self) -> bool:
        """Return whether the client gets the topics and services that the door sees."""

    def receive(self, frame: bytes, *, is_text: bool) -> Sequence[DoorRequest]:
        """Return the requests of a frame, whose text is UTF-8."""

    def failed(self, request: DoorRequest, reason: str) -> None: ...

    def warned(self, reason: str) -> None:
        """Tell the client about something that it did not request."""

    def answered(self, number: int, values: Raw | bytes) -> None: ...

    def parameters(self, values: Mapping[str, object], reply_to: str | None) -> None: ...

    def parameter_changed(self, subscribed: str, name: str, value: Value, now: float) -> None: ...

    def surroundings(self, seen: DoorSurroundings) -> Sequence[DoorRequest]:
        """Announce the surroundings, and return the requests that follow."""

    def ask(self, service: str, values: Raw) -> str: ...

    def give_up(self, call: str) -> None: ...

    def message(self, message: DoorMessage, now: float) -> None: ...

    def next_frame(self, now: float) -> ClientFrame | None:
        """Return the next frame to send now, or None."""

    def next_time(self) -> float | None:
        """Return the time at which the next waiting frame may be sent."""


Protocols = Callable[[str | None], ClientProtocol]
"""Makes the protocol for the subprotocol of the WebSocket."""


class DoorSession:
    """One connection, from the handshake on."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: ClientWriter,
        *,
        door: DoorNode,
        lookout: Lookout,
        protocols: Protocols,
        subprotocols: Sequence[str],
        options: SessionOptions,
        memory: ClientMemory,
        opened: Callable[[], None] = lambda: None,  # called after the handshake
    ) -> None:
        self.end = ""
        self._revoked = False
        self._refusals = RefusalCounts()
        self.began = False
        self._opened = opened
        self.received = self.sent = 0  # frames
        self.received_bytes = self.sent_bytes = self.refusals = 0
        self._reader, self._writer = reader, writer
        self._door = door
        self._lookout = lookout
        self._protocols = protocols
        self._subprotocols = subprotocols
        self._options = options
        self._protocol: ClientProtocol
        self._wills: set[str] = set()  # the topics on which the client has a will
        self._pings = 0
        self.memory = memory  # also that of the protocol's queue
        self._unfinished = 0  # bytes of a frame that has not come whole, as charged to the memory
        self._frame = bytearray()  # the fragments that have come; empty ones take nothing
        self._is_text = False
        self._pieces: list[Body] = []  # of frames for the client
        self._wake = asyncio.Event()
        self._alarm: asyncio.Handle | None = None  # sets `_wake` for a ping or a frame
        self._alarm_time = -math.inf
        self._over = asyncio.Event()
        self._socket = ServerProtocol(
            extensions=[
                ServerPerMessageDeflateFactory(
                    server_max_window_bits=_WINDOW_BITS,
                    client_max_window_bits=_WINDOW_BITS,
                    compress_settings={"level": 1, "memLevel": 5},
                )
            ],
            select_subprotocol=lambda _socket, offered: self._choose(offered),
            max_size=options.frame_bytes,
        )

    @property
    def protocol_name(self) -> str:
        return self._socket.subprotocol or "rosbridge"

    def _choose(self, offered: Sequence[Subprotocol]) -> Subprotocol | None:
        return next((one for one in offered if one in self._subprotocols), None)

    async def run(self) -> None:
        try:
            if await self._handshake():
                await self._serve()
        except TimeoutError:
            began = self._socket.state is not State.CONNECTING
            late = f"no WebSocket handshake in {self._options.handshake_seconds:g} s"
            self.end = self.end or ("the client was silent for too long" if began else late)
        except OSError as error:
            self.end = self.end or f"the connection broke: {error}"
        finally:
            await self._end_connection()
            await self._door.forget(self, wills=not self._revoked)
            self.memory.close()

    async def _handshake(self) -> bool:
        async with asyncio.timeout(self._options.handshake_seconds):
            while not (events := self._socket.events_received()):
                data = await self._reader.read(_READ_BYTES)
                if not data:
                    self.end = "the client left before the handshake"
                    return False
                self._socket.receive_data(data)
                if self._socket.handshake_exc is not None:
                    break
            rejected = ""
            if events and isinstance(events[0], Request):
                rejected = self.end or rejection(events[0].headers, self._options.origins)
                self._socket.send_response(
                    self._socket.reject(HTTPStatus.FORBIDDEN, f"{rejected}\n")
                    if rejected
                    else self._socket.accept(events[0])
                )
            await self._flush()
        if self._socket.state is not State.OPEN:
            self.end = rejected or f"no WebSocket handshake: {self._socket.handshake_exc}"
            return False
        self._protocol = self._protocols(self._socket.subprotocol)
        self.began = True
        self._opened()
        return True

    async def _serve(self) -> None:
        parts = [self._send(), self._receive(), self._leave()]
        if self._protocol.wants_surroundings:
            parts.append(self._watch())
        tasks = [HostTask(self._door.time, self.memory.host, part) for part in parts]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
        for end in ends:
            if isinstance(end, Exception):
                raise end

    async def _end_connection(self) -> None:
        with contextlib.suppress(OSError):
            async with asyncio.timeout(_LAST_SECONDS):
                await self._flush()
                while self._writer.unsent:
                    await asyncio.sleep(_LAST_TURN_SECONDS)
        if self._writer.unsent:
            self._writer.abort()
        else:
            self._writer.close()

    async def _watch(self) -> None:
        while True:
            seen = await self._lookout.look()
            try:
                requests = self._protocol.surroundings(seen)
            except ViewerStalledError as error:
                self._disconnect(CloseCode.POLICY_VIOLATION, str(error))
                return
            self._wake.set()
            for request in requests:
                await self._door.carry_out(request, self)
            await asyncio.sleep(_WATCH_SECONDS)

    async def _leave(self) -> None:
        await self._over.wait()
        await asyncio.sleep(_CLOSING_SECONDS)

    # --- frames of the client ---

    async def _receive(self) -> None:
        size = _READ_DEFLATED_BYTES if self._socket.extensions else _READ_BYTES
        while not self._socket.close_expected():
            data = await self._read(size)
            if data is None:
                break
            if not data:
                self._socket.receive_eof()
                break
            self.received_bytes += len(data)
            self._socket.receive_data(data)
            until = time.thread_time() + TURN_SECONDS
            for event in self._socket.events_received():
                if isinstance(event, WebSocketFrame):
                    await self._take(event)
                if time.thread_time() >= until:
                    await asyncio.sleep(0)
                    until = time.thread_time() + TURN_SECONDS
            self._charge_unfinished()
            self._wake.set()  # for the answer to a ping
            if self._pings > _MAX_PINGS:
                async with asyncio.timeout(self._silent_seconds):
                    await self._flush()
        self.end = self.end or f"the client ended the connection{_reason(self._socket)}"
        if self._socket.parser_exc is not None or self._over.is_set():
            await self._drop_rest()

    @property
    def _silent_seconds(self) -> float:
        return self._options.will_silent_seconds if self._wills else self._options.silent_seconds

    async def _read(self, size: int) -> bytes | None:
        """Return None if the client is disconnected, and nothing at the end. Raises `TimeoutError`."""
        loop, unfinished = asyncio.get_running_loop(), self.memory.unfinished
        until = loop.time() + self._silent_seconds
        while not self._socket.close_expected():
            data, began = None, loop.time()
            try:
                async with asyncio.timeout_at(min(until, began + unfinished.left)) as limit:
                    data = await self._reader.read(size)
            except TimeoutError:
                if not limit.expired() or loop.time() >= until:
                    raise
            if reason := unfinished.waited(loop.time() - began, shares=self.memory.shares):
                self.disconnect(reason)
            elif data is not None:
                return data
        return None

    def _charge_unfinished(self) -> None:
        size = len(self._frame) + len(self._socket.reader.buffer)
        self.memory.add(size - self._unfinished)
        self._unfinished = size
        if size or self._socket.current_size is not None:
            self.memory.unfinished.grew(size)
        else:
            self.memory.unfinished.finished()
        if size > _READ_BYTES and (reason := self.memory.refusal(0)):
            self._disconnect(CloseCode.MESSAGE_TOO_BIG, reason)

    async def _drop_rest(self) -> None:
        """Read for a short time, because otherwise the client would get a reset instead of the closing frame."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLOSING_SECONDS):
                while await self._reader.read(_READ_BYTES):
                    pass

    async def _take(self, frame: WebSocketFrame) -> None:
        self._pings += frame.opcode is Opcode.PING
        if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT) or self._over.is_set():
            return
        if frame.opcode is not Opcode.CONT:
            self._is_text = frame.opcode is Opcode.TEXT
        data = bytes(frame.data)
        if self._frame or not frame.fin:
            self._frame += data
        if frame.fin:
            if self._frame:
                data = bytes(self._frame)
                self._frame.clear()
            size = len(data)
            self.memory.add(-self._unfinished)
            self._unfinished = 0
            self.memory.unfinished.finished()
            # A small frame, such as a stop, is always carried out.
            try:
                with self.memory.holding(_COPIES * size) if size > _READ_BYTES else contextlib.nullcontext():
                    if self._is_text and not data.isascii():
                        data.decode()  # raises; a text is kept as bytes: one letter can make it four times as large
                    await self._carry_out(data)
            except LimitExceededError as error:
                self._disconnect(CloseCode.MESSAGE_TOO_BIG, str(error))
            except UnicodeDecodeError:
                self._disconnect(CloseCode.INVALID_DATA, "a text frame that is not UTF-8")
            except ViewerStalledError as error:
                self._disconnect(CloseCode.POLICY_VIOLATION, str(error))

    async def _carry_out(self, frame: bytes) -> None:
        """Carry out a frame's requests in order. If an advertisement is refused, drop the messages of its topic."""
        self.received += 1
        requests = self._protocol.receive(frame, is_text=self._is_text)
        self._wake.set()
        refused: set[str] = set()
        for request in requests:
            if self._over.is_set():
                return
            if isinstance(request, PublishMessage) and request.topic in refused:
                continue
            try:
                await self._door.carry_out(request, self)
                self._note_will(request)
            except RosError as error:
                self.refusals += 1
                if isinstance(request, AdvertiseTopic):
                    refused.add(request.topic)
                self._protocol.failed(request, str(error))
                self._note_refusal(request, str(error))
                self._wake.set()

    def _note_refusal(self, request: DoorRequest, reason: str) -> None:
        if isinstance(request, AdvertiseTopic | PublishMessage | CallOfService):
            topic = "" if isinstance(request, CallOfService) else request.topic
            if self._refusals.count_refusal(topic, reason, asyncio.get_running_loop().time()):
                self.disconnect(f"{MAX_REFUSALS} refusals in {REFUSAL_SECONDS:g} s: {reason}")

    def _note_will(self, request: DoorRequest) -> None:
        match request:
            case AdvertiseTopic(topic, will=will) if will is not None:
                self._wills.add(topic)
            case UnadvertiseTopic(topic):
                self._wills.discard(topic)

    # --- frames for the client ---

    async def _send(self) -> None:
        loop, options = asyncio.get_running_loop(), self._options
        last_ping = loop.time()
        try:
            while self._socket.state is State.OPEN:
                self._wake.clear()
                now = loop.time()
                taken = self._take_frames(now)
                next_ping = last_ping + (options.will_ping_seconds if self._wills else options.ping_seconds)
                if now >= next_ping:
                    last_ping = now
                    self._socket.send_ping(b"")
                await self._flush()
                self.memory.sent()
                if taken < _BATCH_BYTES:  # otherwise, more may wait
                    due = self._protocol.next_time()
                    self._wake_at(next_ping if due is None else min(due, next_ping))
                    await self._wake.wait()
        finally:
            if self._alarm is not None:
                self._alarm.cancel()
        await self._flush()  # the closing frame
        await asyncio.sleep(_CLOSING_SECONDS)  # for the client's answer to it

    def _wake_at(self, when: float) -> None:
        if self._alarm_time != when:
            if self._alarm is not None:
                self._alarm.cancel()
            self._alarm_time = when
            self._alarm = asyncio.get_running_loop().call_at(when, self._ring)

    def _ring(self) -> None:
        self._alarm, self._alarm_time = None, -math.inf
        self._wake.set()

    def _take_frames(self, now: float) -> int:
        """Take about `_BATCH_BYTES` of the frames that may be sent now; return their number of bytes.

        Without deflate, frames are sent as they are, and large bodies are not copied. `_flush` sends them before
        anything else can be added, so nothing follows a closing frame.
        """
        size, next_frame, deflates = 0, self._protocol.next_frame, bool(self._socket.extensions)
        while size < _BATCH_BYTES and (frame := next_frame(now)) is not None:
            size += frame_size(frame)
            self.sent += 1
            if deflates:
                send = self._socket.send_text if is_text(frame) else self._socket.send_binary
                send(content(frame))
            elif isinstance(frame, bytes):
                self._pieces.append(frame)
            else:
                self._pieces += frame
        return size

    async def _flush(self) -> None:
        if not self._write():
            return
        if self._writer.unsent <= 2 * _BATCH_BYTES:
            await self._writer.drain()
        else:
            await self._wait_for_room()

    def _write(self) -> int:
        """Hand all frames over to the connection, and return their number of bytes."""
        self._pings = 0
        pieces, self._pieces = self._pieces + self._socket.data_to_send(), []
        size = sum(map(len, pieces))
        self.sent_bytes += size
        for data in pieces if size > 2 * _BATCH_BYTES else (b"".join(pieces),):
            if data:
                self._writer.write(data)
        return size

    async def _wait_for_room(self) -> None:
        while True:
            before = self._writer.unsent
            try:
                async with asyncio.timeout(_TAKING_SECONDS) as limit:
                    await self._writer.drain()
                    return
            except TimeoutError:
                if not limit.expired():  # it is an error of the connection
                    raise
            taken = before - self._writer.unsent
            if self.memory.shares and taken < _LEAST_TAKEN:
                self.disconnect(
                    f"the client took {taken} bytes in {_TAKING_SECONDS:g} s, and holds memory that others need"
                )

    def revoke(self, reason: str) -> None:
        """Disconnect the client because its right has ended. Its wills end with the right."""
        self._revoked = True
        self.disconnect(reason)

    def disconnect(self, reason: str) -> None:
        self._disconnect(CloseCode.POLICY_VIOLATION, reason)

    def _disconnect(self, code: CloseCode, reason: str) -> None:
        self.end = self.end or reason
        if self._socket.state is State.OPEN:
            with contextlib.suppress(WebSocketError):
                self._socket.send_close(code, reason.encode()[:_CLOSE_BYTES].decode(errors="ignore"))
        self._over.set()
        self._wake.set()

    # --- the door's side: a `DoorClient` ---

    def heard(self, message: DoorMessage, now: float) -> None:
        self._tell(partial(self._protocol.message, message, now))

    def answered(self, call: int, values: Raw | bytes) -> None:
        self._tell(lambda: self._protocol.answered(call, values))

    def parameters(self, values: Mapping[str, object], reply_to: str | None) -> None:
        self._tell(lambda: self._protocol.parameters(values, reply_to))

    def parameter_changed(self, subscribed: str, name: str, value: Value) -> None:
        self._protocol.parameter_changed(subscribed, name, value, asyncio.get_running_loop().time())
        self._wake.set()

    def failed(self, request: DoorRequest, reason: str) -> None:
        self.refusals += 1
        self._note_refusal(request, reason)
        self._tell(lambda: self._protocol.failed(request, reason))

    def warned(self, reason: str) -> None:
        self._tell(lambda: self._protocol.warned(reason))

    def ask(self, service: str, values: Raw) -> str:
        try:
            return self._protocol.ask(service, values)
        except ViewerStalledError as error:
            self._disconnect(CloseCode.POLICY_VIOLATION, str(error))
            raise ProtocolError(f"the client that offers {service} does not read: {error}") from None
        finally:
            self._wake.set()

    def give_up(self, call: str) -> None:
        self._protocol.give_up(call)

    def _tell(self, tell: Callable[[], None]) -> None:
        try:
            tell()
        except ViewerStalledError as error:
            self._disconnect(CloseCode.POLICY_VIOLATION, str(error))
        self._wake.set()


def _reason(socket: ServerProtocol) -> str:
    if socket.parser_exc is not None:
        return f": {socket.parser_exc}"
    return f" with the code {socket.close_code}" if socket.close_code is not None else ""
