"""Send the api's requests to control, and notices of REST calls without an answer.

At most `_MAX_OPEN` requests are open. A notice never waits: the last `_MAX_KEPT` are kept for the next control.
"""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Callable

import structlog

from appliance.api.front.access import Bearer
from appliance.base import clock
from appliance.channel.admin import A, AdminAnswer, AdminRequest, decode, operation_of
from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.channel.link import Link
from appliance.channel.messages.api import (
    ConnectionAnswered,
    ConnectionPassed,
    LongRequest,
    RequestAnswered,
    RequestMade,
    RequestsRunning,
    RequestWithdrawn,
    RestCalled,
    RestServed,
    TokenKept,
    TokensStated,
    TokenUsed,
)
from appliance.channel.operations import CHANGES, ORDERS
from appliance.channel.rest_operation import ANSWER_SECONDS

_log = structlog.get_logger()
_MAX_OPEN = 48
_MAX_KEPT = 1000
_GRACE_SECONDS = 10.0  # extra time for control to report on an order whose time is over
_UNKNOWN = (
    ": the order may have taken effect; if it has not by now, it never will. Orders that took effect are in the audit"
    " log: rosrv audit search --since 5m (GET /v1/audit)"
)


class ControlAwayError(Exception):
    """Control does not serve a request; the message gives the client the reason.

    `active` is the address of the active appliance, if this one is the standby.
    """

    def __init__(self, reason: str, active: str = "") -> None:
        super().__init__(reason)
        self.active = active


def _make_request(
    number: int, request: AdminRequest[object], bearer: Bearer | None, until: float = math.inf
) -> RequestMade:
    shown = bearer.shown if bearer is not None else ""
    asked = bearer.asked if bearer is not None and type(request) in CHANGES else None
    return RequestMade(number, request, shown, asked, until)


class ControlLink:
    """The link to control; `tokens_stated(tokens)` gets the present tokens; `lost()` is called when control is gone."""

    def __init__(
        self,
        tokens_stated: Callable[[list[TokenKept]], None],
        lost: Callable[[], None],
        *,
        blocks_stated: Callable[[list[str]], None] = lambda _hosts: None,
    ) -> None:
        self._tokens_stated = tokens_stated
        self._blocks_stated = blocks_stated
        self._running: list[LongRequest] = []
        self._lost = lost
        self._link = Link(self._on_message, self._ended)
        self._kept: deque[RestCalled] = deque()
        self._dropped = 0
        self._served = RestServed("")
        self.known = False  # whether this link has stated the tokens
        self.paused = ""  # why control is stopped

    @property
    def connected(self) -> bool:
        return self._link.channel is not None and self.known

    def attach(self, channel: Channel) -> None:
        self.known = False
        self._running = []
        self._link.attach(channel)
        self._tell_pin()

    def state_served(self, pin: str, certificate: str) -> None:
        self._served = RestServed(pin, certificate)
        self._tell_pin()

    def _tell_pin(self) -> None:
        if self._served.pin:
            with contextlib.suppress(ChannelFullError):  # this link ends, and the next link gets the pin
                self._link.send(self._served)

    async def ask(
        self, request: AdminRequest[A], bearer: Bearer | None, seconds: float | None = None
    ) -> AdminAnswer[A]:
        """Return control's answer. Raises `ControlAwayError`.

        A request is withdrawn if the client disconnects, or if it has not taken effect after `seconds`.
        """
        if seconds is None:
            operation = operation_of(request)
            seconds = operation.seconds if operation is not None else ANSWER_SECONDS
        if self.paused:
            raise ControlAwayError(self.paused)
        if self._link.channel is None:
            raise ControlAwayError("the appliance is being restarted: try again in a second")
        if self._link.unanswered >= _MAX_OPEN:
            raise ControlAwayError("too many requests wait for the appliance: try again")
        changes = type(request) in ORDERS
        longest = seconds + _GRACE_SECONDS if changes else seconds
        try:
            answer = await self._ask(request, bearer, clock.now() + seconds, longest)
        except TimeoutError:
            raise ControlAwayError(
                f"the appliance did not answer within {longest:g} s{_UNKNOWN if changes else ''}"
            ) from None
        except ChannelFullError:
            raise ControlAwayError("the appliance does not accept requests now: try again") from None
        except ChannelClosedError:
            raise ControlAwayError(
                f"the appliance was restarted before it answered{_UNKNOWN if changes else ': try again'}"
            ) from None
        return decode(answer, request)

    async def _ask(
        self, request: AdminRequest[object], bearer: Bearer | None, until: float, longest: float
    ) -> bytes:
        number = 0

        def question(given: int) -> RequestMade:
            nonlocal number
            number = given
            return _make_request(number, request, bearer, until)

        def withdraw(gone: "asyncio.Future[None]") -> None:
            if not gone.cancelled():
                with contextlib.suppress(ChannelFullError):  # the request then ends at its time limit
                    self._link.send(RequestWithdrawn(number))

        gone = bearer.gone if bearer is not None else None
        if gone is not None:
            gone.add_done_callback(withdraw)
        try:
            answer: bytes = await self._link.ask(question, longest)
        finally:
            if gone is not None:
                gone.remove_done_callback(withdraw)
        return answer

    async def hand_over(self, name: str, ticket: str, peer: str, descriptor: int) -> tuple[int, str]:
        """Pass a WebSocket to a door; return the HTTP status and the reason of a denial. Raises `ControlAwayError`."""
        if self.paused:
            raise ControlAwayError(self.paused)
        try:
            answer: ConnectionAnswered = await self._link.ask(
                lambda number: ConnectionPassed(number, name, ticket, peer), ANSWER_SECONDS, (descriptor,)
            )
        except (TimeoutError, ChannelFullError, ChannelClosedError):
            raise ControlAwayError("the appliance does not answer now: try again in a second") from None
        return answer.status, answer.reason

    def token_used(self, token: str) -> None:
        """Report the use of a token; while control is away the report is dropped, and a later use is reported."""
        with contextlib.suppress(ChannelFullError):
            self._link.send(TokenUsed(token))

    def state_running(self, requests: list[LongRequest]) -> None:
        if requests != self._running and self._link.channel is not None:
            with contextlib.suppress(ChannelFullError):  # it is stated again later
                self._link.send(RequestsRunning(requests))
                self._running = requests

    def tell(self, call: RestCalled) -> None:
        self._kept.append(call)
        if len(self._kept) > _MAX_KEPT:
            self._dropped += self._kept.popleft().count
        self._tell_kept()

    def _tell_kept(self) -> None:
        while self._kept and self._link.channel is not None:
            try:
                self._link.send(self._kept[0])
            except ChannelFullError:
                return
            except UnicodeEncodeError as error:  # a call that cannot be encoded must not block the others
                _log.error("a REST call cannot be recorded", reason=str(error))
                self._dropped += self._kept[0].count
            self._kept.popleft()
        if self._dropped and self._link.channel is not None:
            _log.warning(
                "REST calls were not recorded: control was not connected, or did not accept them",
                calls=self._dropped,
            )
            self._dropped = 0

    def close(self) -> None:
        self._link.close()

    def _on_message(self, message: object) -> None:
        match message:
            case RequestAnswered(number, answer):
                self._link.answered(number, answer)
            case ConnectionAnswered(number):
                self._link.answered(number, message)
            case TokensStated(tokens, blocked):
                self._blocks_stated(blocked)
                self.known = True
                self._tokens_stated(tokens)
                self._tell_kept()
            case _:
                _log.error("control sent a message that is not for the api", message=type(message).__name__)

    def _ended(self, reason: str) -> None:
        self.known = False
        _log.warning("no control", reason=reason or "control ended")
        self._lost()
