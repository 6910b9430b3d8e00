"""Answer the requests of operators' tools on the admin socket."""

import asyncio
import contextlib
import select
import socket
from typing import Protocol

import msgspec
import structlog

from appliance.base.actors import OPERATOR
from appliance.base.unix_sockets import KEEP_PATH
from appliance.base.validation_messages import refused_field
from appliance.base.withdrawal import withdrawable
from appliance.channel import admin
from appliance.channel.admin import A
from appliance.channel.operations import AnyRequest

_log = structlog.get_logger()
_LINE_LIMIT = 16 << 20


class RequestHandler(Protocol):
    """The part of control that carries out requests."""

    async def carry_out(self, request: admin.AdminRequest[A], *, who: str) -> admin.AdminAnswer[A]:
        """Carry out a request of the client `who`."""


class AdminServer:
    """The server of the admin socket."""

    def __init__(self, administration: RequestHandler) -> None:
        self._administration = administration
        self._decoder = msgspec.json.Decoder(AnyRequest)

    async def start(self, sock: socket.socket) -> asyncio.Server:
        """Return the running server; the caller must keep a reference to it."""
        return await asyncio.start_unix_server(self._serve, sock=sock, limit=_LINE_LIMIT, **KEEP_PATH)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                with withdrawable(lambda: _given_up(writer)):
                    answer = await self.answer(line)
                writer.write(admin.encode(answer) + b"\n")
                await writer.drain()
        except (ValueError, ConnectionError) as error:
            _log.warning("a tool sent an invalid request on the admin socket", error=str(error))
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    async def answer(self, line: bytes) -> admin.AdminAnswer[object]:
        try:
            request = self._decoder.decode(line)
        except ValueError as error:
            text = f"not a request of this version: {error}"
            if str(error).startswith("Expected"):
                where, said = refused_field(error)
                text = f"{where.lstrip('.')}: {said}" if where else said
            return admin.AdminAnswer(False, error=text, trouble="request")
        try:
            return await self._administration.carry_out(request, who=OPERATOR)
        except Exception as error:  # noqa: BLE001  a defect ends one order, not the connection of its operator
            verb = admin.verb_of(request)
            _log.critical("an order ended by a defect", order=verb, exc_info=error)
            text = f"{verb}: a defect in rosrv, please report it with the appliance's log: {error!r}"
            return admin.AdminAnswer(False, error=text, trouble="failed")


def _given_up(writer: asyncio.StreamWriter) -> bool:
    """Return whether the client closed its sending side, which withdraws its request."""
    if writer.is_closing():
        return True
    found = select.poll()
    found.register(writer.get_extra_info("socket").fileno(), select.POLLRDHUP)
    return bool(found.poll(0))
