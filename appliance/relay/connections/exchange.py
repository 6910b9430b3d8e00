"""The requests and replies of one service connection after the headers, without sockets.

- The service has at most one request at a time. A reply without a request is an error.
- While a client has an open request or does not read its replies, the relay reads nothing from it.
- A request that needs an approval is held; only `settle` passes it to monitors and the service.
"""

from collections import deque
from collections.abc import Callable

from appliance.relay.monitors.interceptor import ServiceVerdict
from roswire.errors import ProtocolError
from roswire.tcpros import (
    FrameParser,
    ServiceReply,
    ServiceReplyParser,
    encode_frame,
    encode_service_error,
    encode_service_reply,
)

_REPLY_HEAD = 5  # bytes before the body of a reply


class ServiceExchange:
    """The requests and replies of one connection.

    `held` counts the bytes of incomplete and waiting requests, `held_replies` those of incomplete replies.
    """

    def __init__(
        self,
        limit: int,
        *,
        persistent: bool,
        to_service: Callable[[bytes], None],
        to_client: Callable[[bytes], None],
        count: Callable[[int], None],
        judge: Callable[[str, bytes], ServiceVerdict] | None = None,
        asks: Callable[[bytes], bool] = lambda _body: False,
    ) -> None:
        self._persistent = persistent
        self._to_service = to_service
        self._to_client = to_client
        self._count = count
        self._judge = judge
        self._asks = asks
        self._asking: bytes | None = None
        self._requests = FrameParser(limit)
        self._replies = ServiceReplyParser(limit)
        self._waiting: deque[bytes] = deque()
        self._busy = False
        self.done = False
        self.held = 0
        self.held_replies = 0

    @property
    def may_read(self) -> bool:
        return not self._busy and self._asking is None and not self._waiting and not self.done

    @property
    def ready(self) -> bool:
        return bool(self._waiting) and not self._busy and self._asking is None and not self.done

    @property
    def unfinished(self) -> int:
        return self.held_replies + (0 if self._waiting else self.held)

    def from_client(self, data: bytes) -> None:
        self.held += len(data)
        self._waiting.extend(self._requests.feed(data))

    def from_service(self, data: bytes) -> None:
        self.held_replies += len(data)
        for reply in self._replies.feed(data):
            if not self._busy:
                raise ProtocolError("the service sent a reply without a request")
            self._reply(reply)

    def advance(self) -> None:
        if self.ready:
            body = self._asking = self._waiting.popleft()
            if not self._asks(body):
                self.settle("")

    def settle(self, refused: str) -> None:
        body, self._asking = self._asking, None
        if body is None:
            raise RuntimeError("no request is held")
        if refused:
            self._pass_on(encode_frame(body))
            self._refuse(refused)
        else:
            self._request(body)

    def _request(self, body: bytes) -> None:
        data = encode_frame(body)
        self._pass_on(data)
        if self._judge is not None:
            judged = self._judge("request", body)
            if judged.refused is not None:
                self._refuse(judged.refused)
                return
            if judged.body is not body:
                data = encode_frame(judged.body)
        self._busy = True
        self._to_service(data)

    def _refuse(self, reason: str) -> None:
        self.done = not self._persistent
        data = encode_service_error(reason)
        self._count(len(data))
        self._to_client(data)

    def _reply(self, reply: ServiceReply) -> None:
        self.held_replies -= len(reply.body) + _REPLY_HEAD
        if reply.ok and self._judge is not None:
            judged = self._judge("response", reply.body)
            reply = (
                ServiceReply(True, judged.body)
                if judged.refused is None
                else ServiceReply(False, judged.refused.encode())
            )
        if reply.ok:
            data = encode_service_reply(reply.body)
        else:
            data = encode_service_error(reply.body.decode("utf-8", "replace"))
        self._busy = False
        self.done = not self._persistent
        self._count(len(data))
        self._to_client(data)

    def _pass_on(self, data: bytes) -> None:
        self.held -= len(data)
        self._count(len(data))
