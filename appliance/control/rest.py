"""Control's end of the link to the api: takes what REST asks, one request after the other, and what it did.

Invariants, so that an api that is flooded or has fallen to a stranger cannot hold RVMaster up:

1. At most `_MOST_WAITING` requests wait; one more is answered `busy` at once. Between two of them the loop serves
   nodes. Those that wait for others (`WaitingRequest`, at most `_MOST_SLOW`) hold up nobody else.
2. What is not of the link ends it; an api that does not read its answers loses the link.
3. Nothing that can be asked here makes an access token, and no decision of RVMaster depends on the api.
4. What no client waits for any more is withdrawn before it takes effect (`appliance/base/withdrawal.py`).
5. Everything is asked in the name of a token that was shown and whose role may; a change is what the client asked for,
   with its proof (`rest_proof.py`). What is not is refused and recorded, by control itself.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import structlog

from appliance.audit.record import Severity
from appliance.base.withdrawal import awaited
from appliance.channel import messages
from appliance.channel.admin import (
    ORDERS,
    AdminAnswer,
    ChallengeWanted,
    WaitingRequest,
    encode,
    verb_of,
)
from appliance.channel.channel import Channel, ChannelFullError
from appliance.channel.link import Link
from appliance.channel.messages.api import (
    RequestAnswered,
    RequestMade,
    RequestWithdrawn,
    RestCalled,
    RestServed,
    TokensStated,
)
from appliance.control.administration import Administration
from appliance.control.rest_proof import Askers, UnprovenError
from appliance.control.token_orders import Tokens
from appliance.telemetry.audit_trail import AuditTrail

_log = structlog.get_logger()
_MOST_WAITING = 64
_TEXT = 300
_DENIED = (401, 403, 421, 429)
_METHODS = ("POST", "PUT", "PATCH", "DELETE")  # refused in whatever way, nothing was changed
_MOST_SLOW = 16


class RestLink:
    """Serves whichever api is there.

    `served(pin)` hears by what hosts recognise it. `require_proof`: a change is made for a signed request only, not for
    a bare token.
    """

    def __init__(
        self,
        administration: Administration,
        tokens: Tokens,
        trail: AuditTrail,
        *,
        served: Callable[[str], None],
        require_proof: bool,
    ) -> None:
        self._administration = administration
        self._tokens = tokens
        self._askers = Askers(tokens, require_proof=require_proof)
        self._trail = trail
        self._link = Link(self._received, self._lost)
        self._waiting: deque[RequestMade] = deque()
        self._withdrawn: dict[int, bool] = {}  # of the requests of the present link that are not answered
        self._worker: asyncio.Task[None] | None = None  # of the present link
        self._slow: set[asyncio.Task[None]] = set()
        self._workers: set[asyncio.Task[None]] = set()  # that, and those of links that ended amid a request
        self._served = served

    def attach(self, channel: Channel) -> None:
        """An api is there: serve it, and tell it the tokens."""
        self._link.attach(channel)
        self._worker = None
        self._waiting.clear()
        self._withdrawn = {}
        self.state_tokens()

    def _received(self, message: object) -> None:
        match message:
            case RequestMade(number):
                if len(self._waiting) >= _MOST_WAITING:
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
            case RestServed(pin):
                self._served(pin)
            case _:
                self._link.close()
                self._lost(f"it sent {type(message).__name__}")

    async def _work(self, channel: Channel | None) -> None:
        while self._waiting and channel is self._link.channel:
            made = self._waiting.popleft()
            if isinstance(made.request, WaitingRequest):
                self._begin(channel, made)
            else:
                await self._serve(channel, made)
            await asyncio.sleep(0)

    def _begin(self, channel: Channel | None, made: RequestMade) -> None:
        """Serve beside the others what waits for charon, the signer, the recorder or a topic's messages."""
        if len(self._slow) >= _MOST_SLOW:
            text = "too many requests that take a while are under way: try again"
            self._send_answer(made.number, AdminAnswer(False, error=text, trouble="busy"))
            return
        task = asyncio.get_running_loop().create_task(self._serve(channel, made))
        self._slow.add(task)
        task.add_done_callback(self._slow.discard)

    async def _serve(self, channel: Channel | None, made: RequestMade) -> None:
        withdrawn = self._withdrawn

        def given_up() -> bool:
            gone = withdrawn.get(made.number, False) or channel is not self._link.channel
            return gone or time.monotonic() > made.until

        with awaited(given_up):
            answer = await self._answer(made)
        if channel is self._link.channel:
            self._send_answer(made.number, answer)

    async def _answer(self, made: RequestMade) -> AdminAnswer[Any]:
        if type(made.request) in ORDERS and self._trail.obstacle is not None:
            return AdminAnswer(False, error=self._trail.obstacle, trouble="failed")
        try:
            who = await self._askers.asker(made)
            if isinstance(made.request, ChallengeWanted):
                return AdminAnswer(True, self._askers.challenge())
            return await self._administration.carry_out(made.request, who=who)
        except UnprovenError as error:
            self._refused(made, error)
            return AdminAnswer(False, error=str(error), trouble="forbidden")
        except Exception as error:  # noqa: BLE001  a defect of one request is that request's failure
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
        """Tell the api what tokens may be used."""
        self._send(TokensStated(self._tokens.usable()))

    def _send_answer(self, number: int, answer: AdminAnswer[Any]) -> None:
        self._withdrawn.pop(number, None)
        self._send(RequestAnswered(number, encode(answer)))

    def _send(self, message: messages.Message) -> None:
        try:
            self._link.send(message)
        except ChannelFullError:
            self._link.close()
            _log.error("the api does not read its answers: its link is closed")

    def _lost(self, wrong: str) -> None:
        """The link is gone; `wrong` is what the api did to lose it, empty when it ended: the supervisor says why."""
        self._waiting.clear()
        if wrong:
            _log.error("the api's link is closed; another one is started", reason=wrong)
