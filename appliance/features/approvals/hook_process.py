"""Send the web hook calls that wait, as a process of the appliance.

1. It only sends: control learns from it whether a call was sent, and nothing else. It reads only the status of
   the receiver's answer: 2xx shows that the receiver took the call. So no redirect is followed.
2. The firewall and the sandbox let it reach the receiver, and nothing else.
3. A slow receiver delays no call and no order: the queue has a bound, and each POST a deadline.
"""

import asyncio
import hashlib
import hmac
import html
import json
import re
import socket
import ssl
from pathlib import Path

import structlog

from appliance.audit.log.record_format import printable
from appliance.base import clock
from appliance.base.input_files import path_for_library, read_given
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.approvals.hook_link import CallSent, CallWaits, HookLink
from appliance.features.approvals.settings import ApprovalHook

# The POST for a call that waits. No I/O.
#
# 1. The signature covers the time and the body, so a receiver can reject repetitions and changes.
# 2. Text of an agent is shown without control characters, and without the characters of HTML and of links in chats.

LEAST_SECRET = 16
_LONGEST_TEXT = 200
_DOES = {"publish": "publish", "call": "call", "write": "write"}


def body_of(call: CallWaits, left: float, robot: str, console: str) -> bytes:
    """Return the JSON; `left` is the number of seconds until the call expires."""
    host, node, resource, type_ = map(_harmless, (call.host, call.caller_id, call.resource, call.type))
    does = _DOES.get(call.category, "use")
    where = f"{_harmless(robot)}: " if robot else ""
    link = f"{console}/console/robot" if console else ""
    fields = {
        "event": "approval wanted", "robot": _harmless(robot), "number": call.number, "host": host, "node": node,
        "category": call.category, "resource": resource, "type": type_, "expires_in_seconds": round(left, 1),
        "console": link,
        "text": f"{where}{host} wants to {does} {resource}: approval {call.number}, {left:.0f} s left. {link}".rstrip(),
    }  # fmt: skip
    return json.dumps(fields).encode()


def request_of(wanted: ApprovalHook, body: bytes, secret: bytes, seconds: int) -> bytes:
    """Return the whole request; `seconds` is the time of the signature, since the epoch."""
    signature = hmac.new(secret, f"{seconds}.".encode() + body, hashlib.sha256).hexdigest()
    head = (
        f"POST {wanted.target} HTTP/1.1",
        f"Host: {wanted.host[1]}",
        "Content-Type: application/json",
        f"Content-Length: {len(body)}",
        f"ROSRV-Signature: t={seconds},v1={signature}",
        "Connection: close",
    )
    return "\r\n".join((*head, "", "")).encode() + body


def _harmless(text: str) -> str:
    return html.escape(printable(text[:_LONGEST_TEXT]))


_log = structlog.get_logger()
MAX_WAITING = 64
_AT_ONCE = 4
_SECONDS = 5.0
_LONGEST_SECRET = 4096
_STATUS = re.compile(rb"HTTP/1\.[0-9] ([0-9]{3})")


def main(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Process(load_resolved(config), lifeline_fd).run())


class _Process:
    def __init__(self, settings: Settings, lifeline_fd: int) -> None:
        lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        self._child = Child(lifeline, HookLink, said=self._said)
        self._sender = HookSender(settings.of(ApprovalHook), settings.name)
        self._queue: asyncio.Queue[tuple[CallWaits, float]] = asyncio.Queue(MAX_WAITING)

    async def run(self) -> None:
        workers = [asyncio.create_task(self._work()) for _ in range(_AT_ONCE)]
        self._child.attach(messages.Ready())
        await self._child.ended.wait()
        for worker in workers:
            worker.cancel()

    def _said(self, message: object) -> None:
        if not isinstance(message, CallWaits):
            raise TypeError(f"control sent {type(message).__name__}, which is not for hook")
        try:
            self._queue.put_nowait((message, clock.now() + message.seconds))
        except asyncio.QueueFull:
            self._child.tell(CallSent(message.number, f"{MAX_WAITING} calls are already in the queue"))

    async def _work(self) -> None:
        while True:
            call, ends = await self._queue.get()
            trouble = await self._sender.send(call, ends)
            if trouble:
                _log.warning("the web hook did not get a call", number=call.number, reason=trouble)
            self._child.tell(CallSent(call.number, trouble))


class HookSender:
    """Sends the POST for a call."""

    def __init__(self, wanted: ApprovalHook, robot: str) -> None:
        self._wanted, self._robot = wanted, robot

    async def send(self, call: CallWaits, ends: float) -> str:
        """Return why the call was not sent, or an empty string; `ends` is monotonic."""
        left = ends - clock.now()
        if left <= 0:
            return "it expired before it could be sent"
        try:
            body = body_of(call, left, self._robot, self._wanted.console)
            return await self._post(request_of(self._wanted, body, self._secret(), int(clock.wall())))
        except TimeoutError:
            return f"no answer within {_SECONDS:g} s"
        except (OSError, ValueError) as error:
            return f"{type(error).__name__}: {error}"
        except Exception as error:  # noqa: BLE001  a defect affects only this call
            _log.exception("a call was not sent")
            return f"a defect of rosrv: {type(error).__name__}"

    async def _post(self, request: bytes) -> str:
        async with asyncio.timeout(_SECONDS):
            reader, writer = await asyncio.open_connection(
                *self._wanted.destination,
                ssl=self._context(),
                server_hostname=self._wanted.host[0],
                limit=1024,
            )
            try:
                writer.write(request)
                await writer.drain()
                begin = await reader.readexactly(len("HTTP/1.1 200"))
            except asyncio.IncompleteReadError as error:
                begin = error.partial
            finally:
                writer.transport.abort()
        status = _STATUS.fullmatch(begin)
        if status is None:
            return f"the answer of {self._wanted.host[1]} is not of HTTP: {begin!r}"
        return "" if status[1].startswith(b"2") else f"{self._wanted.host[1]} answered {status[1].decode()}"

    def _context(self) -> ssl.SSLContext:
        if self._wanted.ca is None:
            return ssl.create_default_context()
        with path_for_library(self._wanted.ca) as path:
            return ssl.create_default_context(cafile=path)

    def _secret(self) -> bytes:
        """Read the secret for each call, so that a replaced file applies."""
        assert self._wanted.secret_file is not None  # noqa: S101  the role runs only with it
        lines = read_given(self._wanted.secret_file, _LONGEST_SECRET).splitlines()
        if not lines or len(lines[0]) < LEAST_SECRET:
            raise ValueError(
                f"the first line of {self._wanted.secret_file} has fewer than {LEAST_SECRET} characters: write a"
                " longer secret"
            )
        return lines[0]
