"""The requests and replies of one service connection after the headers, without sockets.

- The service has at most one request at a time. A reply without a request is an error.
- While a client has an open request or does not read its replies, the relay reads nothing from it.
- A request that needs an approval is held; only `settle` passes it to monitors and the service.
"""

from collections import deque
from collections.abc import Callable

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
        judge: Callable[[str, bytes], ServiceReply],
        asks: Callable[[bytes], bool],
    ) -> None:
        self._persistent = persistent
        self._to_service = to_service
        self._to_client = to_client
        self._count = count
        self._judge = judge
        self._asks = asks
        self._requests = FrameParser(limit)
        self._replies = ServiceReplyParser(limit)
        self._waiting: deque[bytes] = deque()
        self._asking = False  # whether the first waiting request needs an approval
        self._busy = False
        self.done = False
        self.held = 0
        self.held_replies = 0

    @property
    def may_read(self) -> bool:
        return not self._busy and not self._waiting and not self.done

    @property
    def ready(self) -> bool:
        return bool(self._waiting) and not self._busy and not self._asking and not self.done

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
            self.held_replies -= len(reply.body) + _REPLY_HEAD
            self._busy = False
            self._answer(self._judge("response", reply.body) if reply.ok else reply)

    def advance(self) -> None:
        if self.ready:
            self._asking = self._asks(self._waiting[0])
            if not self._asking:
                self.settle("")

    def settle(self, refused: str) -> None:
        """Pass the first waiting request on, or refuse it for this reason."""
        self._asking = False
        body = self._waiting.popleft()
        data = encode_frame(body)
        self.held -= len(data)
        self._count(len(data))
        judged = ServiceReply(False, refused.encode()) if refused else self._judge("request", body)
        if judged.ok:
            self._busy = True
            self._to_service(data if judged.body is body else encode_frame(judged.body))
        else:
            self._answer(judged)

    def _answer(self, reply: ServiceReply) -> None:
        text = "" if reply.ok else reply.body.decode("utf-8", "replace")
        data = encode_service_reply(reply.body) if reply.ok else encode_service_error(text)
        self.done = not self._persistent
        self._count(len(data))
        self._to_client(data)
