"""Pass the WebSocket of a viewer on to a door, after TLS.

1. Only the name of the door follows the request further: neither the door nor a log gets the ticket.
2. Neither side is read while the other one does not read, so a client that stalls costs two small buffers.
3. A peer that shows wrong tickets must wait, as with wrong tokens.
"""

import asyncio
import hashlib
import hmac
import secrets
import socket
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import cast
from urllib.parse import parse_qs, urlsplit

from appliance.api.front.access import TokenAuthenticator
from appliance.api.front.control import ControlAwayError, ControlLink
from appliance.api.front.problems import ProblemError
from appliance.api.front.request_gate import RequestGate
from appliance.base import clock

# Remember the tickets of doors that peers showed. No I/O.
#
# 1. A wrong ticket counts once a minute for its peer: a page that was left open shows its ended ticket again and
# again,
#    and must not keep the other pages of its address out. Control does not hear of the repetitions.
# 2. A ticket that opened its door is passed on even while its peer must wait for others of its address.
# 3. Tickets are remembered only as hashes under a random key of this process.

_WRONG_SECONDS = 60.0
_MAX = 1024  # right ones, and as many wrong ones
_WRONG = "the ticket is wrong or over: ask the operator for a new one (rosrv door ticket NAME)"


class ShownTickets:
    """The tickets of all peers. Wrong ones count as the peer's failures at the `doorkeeper`."""

    def __init__(self, doorkeeper: TokenAuthenticator) -> None:
        self._doorkeeper = doorkeeper
        self._key = secrets.token_bytes(32)
        self._right: OrderedDict[bytes, float] = OrderedDict()
        self._wrong: OrderedDict[bytes, float] = OrderedDict()

    def digest_of(self, target: bytes) -> str:
        """Return a digest of the ticket in a URL if it was valid before, or an empty text."""
        with suppress(ProblemError):
            digest = self._digest(*_entry_of(target))
            return digest.hex() if digest in self._right else ""
        return ""

    def require(self, peer: str, name: str, ticket: str) -> None:
        """Raise `ProblemError` (401, 429) if control need not be asked about this ticket now."""
        shown = self._digest(name, ticket)
        if clock.now() - self._wrong.get(shown, -_WRONG_SECONDS) < _WRONG_SECONDS:
            raise ProblemError(401, "not-recognised", _WRONG)
        if shown not in self._right:
            self._doorkeeper.require_patience(peer)

    def answered(self, peer: str, name: str, ticket: str, *, valid: bool) -> None:
        shown = self._digest(name, ticket)
        self._doorkeeper.note_attempt(peer, valid=valid)
        for kept in (self._right, self._wrong):
            kept.pop(shown, None)
        kept = self._right if valid else self._wrong
        kept[shown] = clock.now()
        if len(kept) > _MAX:
            kept.popitem(last=False)

    def _digest(self, name: str, ticket: str) -> bytes:
        return hmac.digest(self._key, f"{name}\0{ticket}".encode("utf-8", "replace"), hashlib.sha256)


PREFIX = b"/door/"
_NOTE_SECONDS = 60.0
_LONGEST = 200  # characters of a name or a ticket


class WebSocketPassage(asyncio.Protocol):
    """The protocol of the door's end of the socket pair."""

    def __init__(self, client: asyncio.Transport, target: bytes) -> None:
        self.client = client
        self.target = target
        self.note: Callable[[], None] = lambda: None
        self._noted = clock.now()
        self._service: asyncio.Transport | None = None
        self._held: list[bytes] = []

    @property
    def peer(self) -> str:
        return str(self.client.get_extra_info("peername")[0])

    def from_client(self, data: bytes) -> None:
        if self._service is None:
            self.client.pause_reading()  # until the door takes the connection
            self._held.append(data)
        else:
            self._service.write(data)
            if clock.now() - self._noted > _NOTE_SECONDS:  # so that no flood of unknown peers displaces it
                self._noted = clock.now()
                self.note()

    def client_left(self) -> None:
        if self._service is not None:
            self._service.close()

    def hold_service(self, *, held: bool) -> None:
        if self._service is not None and not self._service.is_closing():
            (self._service.pause_reading if held else self._service.resume_reading)()

    def refuse(self, status: str, reason: str) -> None:
        body = f"{reason}\n".encode()
        head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nConnection: close\r\n"
        self.client.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        self.client.close()

    # --- the door's end ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._service = cast(asyncio.Transport, transport)
        if self.client.is_closing():
            self._service.close()

    def begin(self, head: bytes) -> None:
        if self._service is None:
            return
        self._service.write(head)
        for data in self._held:
            self._service.write(data)
        self._held.clear()
        if not self.client.is_closing():
            self.client.resume_reading()

    def data_received(self, data: bytes) -> None:
        self.client.write(data)

    def connection_lost(self, _error: Exception | None) -> None:
        self.client.close()

    def pause_writing(self) -> None:
        if not self.client.is_closing():
            self.client.pause_reading()

    def resume_writing(self) -> None:
        if not self.client.is_closing():
            self.client.resume_reading()


class WebSocketHandover:
    """Passes WebSockets on to control."""

    def __init__(self, control: ControlLink, doorkeeper: TokenAuthenticator, gate: RequestGate) -> None:
        self._control = control
        self._doorkeeper = doorkeeper
        self._gate = gate
        self._tickets = ShownTickets(doorkeeper)

    async def pass_on(self, passage: WebSocketPassage, head: bytes) -> None:
        """Pass a WebSocket on, or answer with the reason of the refusal."""
        host = passage.peer
        try:
            self._gate.admit_websocket(host, PREFIX.decode(), self._tickets.digest_of(passage.target))
            name, ticket = _entry_of(passage.target)
            self._tickets.require(host, name, ticket)
            here, there = socket.socketpair()
            with there:
                try:
                    status, reason = await self._control.hand_over(name, ticket, host, there.fileno())
                    if status in (101, 401):
                        self._tickets.answered(host, name, ticket, valid=status == 101)
                    if reason:
                        raise ProblemError(status, "not-recognised", reason)
                    here.setblocking(False)
                    await asyncio.get_running_loop().create_unix_connection(lambda: passage, sock=here)
                except BaseException:
                    here.close()
                    raise
        except ProblemError as problem:
            passage.refuse(f"{problem.status} Refused", problem.detail)
            return
        except ControlAwayError as error:
            passage.refuse("503 Service Unavailable", str(error))
            return
        passage.note = partial(self._doorkeeper.note_attempt, host, valid=True)
        passage.begin(_without_ticket(head, name))


def _entry_of(target: bytes) -> tuple[str, str]:
    """Return the door and the ticket. Raises `ProblemError`."""
    try:
        parts = urlsplit(target.decode("ascii"))
        ticket = parse_qs(parts.query).get("ticket", [""])[0]
    except ValueError:
        raise ProblemError(
            400, "bad-input", "the URL is not valid: take it from `rosrv door ticket`"
        ) from None
    name = parts.path.removeprefix(PREFIX.decode())
    if not ticket or max(len(ticket), len(name)) > _LONGEST:
        raise ProblemError(
            401, "not-recognised", "the URL has no ticket: use the one of `rosrv door ticket NAME`"
        )
    return name, ticket


def _without_ticket(head: bytes, name: str) -> bytes:
    _line, _end, rest = head.partition(b"\n")
    return b"GET /door/" + name.encode("ascii") + b" HTTP/1.1\r\n" + rest
