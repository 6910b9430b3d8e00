"""Carry out the REST requests that the api passes on, one by one, and record REST calls.

A flooded or compromised api cannot block RVMaster:

1. At most `_MAX_WAITING` requests wait; the rest are answered `busy` at once. Between two requests, the event loop
   serves nodes.
2. Questions that wait for another process (`WaitingRequest`) and orders, which wait for the audit log and may wait for
   relays or the compiler, do not delay other requests, at most `_MAX_SLOW` of each, so that questions keep no order
   waiting. An order beyond these is served in turn.
3. The link ends if the api sends an invalid message or does not read its answers.
4. REST requests cannot make access tokens, and RVMaster's decisions do not depend on the api.
5. A request needs a token whose role allows it, and a change also the client's own HTTP request, with a proof if the
   settings require it (`rest_proof.py`). Control denies and records all other requests.
"""

import asyncio
import os
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

import structlog

from appliance.audit.log.record import Severity
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.withdrawal import withdrawable
from appliance.channel import messages
from appliance.channel.admin import AdminAnswer, ChallengeWanted, WaitingRequest, encode, verb_of
from appliance.channel.channel import Channel, ChannelFullError
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
from appliance.channel.operations import ORDERS
from appliance.control.operators.administration import Administration
from appliance.control.rest.rest_proof import RequestAuthenticator, UnprovenError, UsableTokens
from appliance.policy.host_sets import canonical_address
from appliance.policy.model import Address, address_of
from appliance.telemetry.audit_trail import AuditTrail

# Note who uses REST and the console from which host, for the answer to a block (`HostUses`).

_RECENT_SECONDS = 900.0
_MAX_RECENT = 1000


class RestUses:
    """The people and programs that lately used REST and the console, and the requests that still run.

    `blocked()` returns the hosts that REST must refuse.
    """

    def __init__(self, blocked: Callable[[], Iterable[Address]] = tuple) -> None:
        self.blocked = blocked
        self._recent: OrderedDict[tuple[Address, str], float] = OrderedDict()  # oldest first
        self._running: list[LongRequest] = []

    def called(self, host: str, who: str) -> None:
        key = _address(host), who
        if key[0] is None or not who:
            return
        self._recent[key[0], who] = clock.now()
        self._recent.move_to_end((key[0], who))
        while len(self._recent) > _MAX_RECENT:
            self._recent.popitem(last=False)

    def running(self, requests: list[LongRequest]) -> None:
        self._running = requests

    def of(self, host: Address) -> Iterable[str]:
        now = clock.now()
        for (address, who), at in self._recent.items():
            if address == host and now - at < _RECENT_SECONDS:
                yield f"session of {who} (REST, last call {now - at:.0f} s ago)"
        for one in self._running:
            if _address(one.host) == host:
                yield f"{counted(one.count, 'follower')} of {one.who} ({one.path})"


def _address(text: str) -> Address | None:
    try:
        return canonical_address(address_of(text))
    except ValueError:
        return None


_log = structlog.get_logger()
_MAX_WAITING = 64
_TEXT = 300
_DENIED = (401, 403, 421, 429)
_METHODS = ("POST", "PUT", "PATCH", "DELETE")  # a rejected request with one of these methods changed nothing
_MAX_SLOW = 16
NO_WEBSOCKETS = (503, "this appliance opens no doors now")


class RestTokens(UsableTokens, Protocol):
    def usable(self) -> list[TokenKept]:
        """Return the tokens that the api accepts."""

    def ended(self) -> list[TokenKept]:
        """Return the latest tokens that have expired: the api tells their owners."""

    def used(self, token_id: str) -> None:
        """Note that a token was used."""


class RestLink:
    """The link to the api.

    `served(pin)` gets the pin by which hosts recognise the api. `connected` passes a WebSocket on; it returns a
    status and the reason of a refusal.
    """

    def __init__(
        self,
        administration: Administration,
        tokens: RestTokens,
        trail: AuditTrail,
        *,
        served: Callable[[str], None],
        certified: Callable[[str], None],
        require_proof: bool,
        uses: RestUses,
        connected: Callable[[str, str, str, int], tuple[int, str]] = lambda *_connection: NO_WEBSOCKETS,
    ) -> None:
        self._administration = administration
        self._tokens = tokens
        self._askers = RequestAuthenticator(tokens, require_proof=require_proof)
        self._trail = trail
        self._link = Link(self._on_message, self._lost, self._took)
        self._connected = connected
        self._uses = uses
        self._waiting: deque[RequestMade] = deque()
        self._withdrawn: dict[int, bool] = {}  # unanswered requests of the present link, by number
        self._worker: asyncio.Task[None] | None = None  # the worker of the present link
        self._slow: Mapping[bool, set[asyncio.Task[None]]] = {
            True: set(),
            False: set(),
        }  # by whether it is an order
        self._workers: set[asyncio.Task[None]] = set()  # the workers of present and ended links
        self._served, self._certified = served, certified

    def attach(self, channel: Channel) -> None:
        self._link.attach(channel)
        self._worker = None
        self._waiting.clear()
        self._withdrawn = {}
        self.state_tokens()

    def _on_message(self, message: object) -> None:
        match message:
            case RequestMade(number):
                if len(self._waiting) >= _MAX_WAITING:
                    text = "too many requests wait for the appliance: try again"
                    self._send_answer(number, AdminAnswer(False, error=text, trouble="busy"))
                    return
                self._waiting.append(message)
                self._withdrawn[number] = False
                if self._worker is None or self._worker.done():
                    self._worker = asyncio.get_running_loop().create_task(self._work(self._link.channel))
                    self._workers.add(self._worker)
                    self._worker.add_done_callback(self._workers.discard)
            case RequestWithdrawn(number):
                if number in self._withdrawn:
                    self._withdrawn[number] = True
            case RestCalled():
                self._record(message)
            case RequestsRunning(requests):
                self._uses.running(requests)
            case TokenUsed(token):
                self._tokens.used(token)
            case RestServed(pin, certificate):
                self._served(pin)
                self._certified(certificate)
            case _:
                self._link.close()
                self._lost(f"it sent {type(message).__name__}")

    def _took(self, message: object, descriptors: tuple[int, ...]) -> None:
        try:
            if isinstance(message, ConnectionPassed):
                status, reason = self._connected(message.name, message.ticket, message.peer, descriptors[0])
                self._send(ConnectionAnswered(message.number, status, reason))
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    async def _work(self, channel: Channel | None) -> None:
        while self._waiting and channel is self._link.channel:
            made = self._waiting.popleft()
            order = type(made.request) in ORDERS
            running = self._slow[order]
            if isinstance(made.request, WaitingRequest) or (order and len(running) < _MAX_SLOW):
                self._begin(channel, made, running)
            else:
                await self._serve(channel, made)
            await asyncio.sleep(0)

    def _begin(self, channel: Channel | None, made: RequestMade, running: set[asyncio.Task[None]]) -> None:
        if len(running) >= _MAX_SLOW:
            text = "too many long requests are running: try again"
            self._send_answer(made.number, AdminAnswer(False, error=text, trouble="busy"))
            return
        task = asyncio.get_running_loop().create_task(self._serve(channel, made))
        running.add(task)
        task.add_done_callback(running.discard)

    async def _serve(self, channel: Channel | None, made: RequestMade) -> None:
        withdrawn = self._withdrawn

        def given_up() -> bool:
            gone = withdrawn.get(made.number, False) or channel is not self._link.channel
            return gone or clock.now() > made.until

        host = made.asked.host if made.asked is not None else ""
        with withdrawable(given_up, host):
            answer = await self._answer(made)
        if channel is self._link.channel:
            self._send_answer(made.number, answer)

    async def _answer(self, made: RequestMade) -> AdminAnswer[object]:
        try:
            who = await self._askers.asker(made)
            if isinstance(made.request, ChallengeWanted):
                return AdminAnswer(True, self._askers.challenge())
            return await self._administration.carry_out(made.request, who=who)
        except UnprovenError as error:
            self._refused(made, error)
            return AdminAnswer(False, error=str(error), trouble="forbidden")
        except Exception as error:  # noqa: BLE001  a defect affects only this request
            _log.exception("a request of the api failed", request=type(made.request).__name__)
            return AdminAnswer(False, error=f"a defect of rosrv: {type(error).__name__}", trouble="failed")

    def _refused(self, made: RequestMade, error: UnprovenError) -> None:
        asked = made.asked
        self._trail.happened(
            "order refused",
            str(error)[:_TEXT],
            severity=error.severity,
            decision="deny",
            host=asked.host[:_TEXT] if asked is not None else None,
            category="rest",
            resource=asked.target.partition("?")[0][:_TEXT] if asked is not None else "",
            who=error.who or None,
            verb=verb_of(made.request),
        )

    def _record(self, call: RestCalled) -> None:
        self._uses.called(call.host, call.who)
        denied = call.status in _DENIED or (call.method in _METHODS and call.status >= 400 and not call.dry)
        self._trail.happened(
            "rest call",
            call.reason[:_TEXT],
            severity=Severity.WARNING if denied else Severity.INFO,
            decision="deny" if denied else "allow",
            host=call.host,
            category="rest",
            resource=call.path[:_TEXT],
            who=call.who or None,
            method=call.method[:_TEXT],
            more={"dry_run": True} if call.dry else None,
            status=call.status,
            took_us=call.duration_us,
            count=call.count,
        )

    def state_tokens(self) -> None:
        tokens = [*self._tokens.usable(), *self._tokens.ended()]
        self._send(TokensStated(tokens, [*map(str, self._uses.blocked())]))

    def _send_answer(self, number: int, answer: AdminAnswer[object]) -> None:
        self._withdrawn.pop(number, None)
        self._send(RequestAnswered(number, encode(answer)))

    def _send(self, message: messages.Message) -> None:
        try:
            self._link.send(message)
        except ChannelFullError:
            self._link.close()
            _log.error("the api does not read its answers: its link is closed")

    def _lost(self, wrong: str) -> None:
        self._waiting.clear()
        if wrong:
            _log.error("the api's link is closed; another one is started", reason=wrong)
