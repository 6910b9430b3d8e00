"""Answer with ETags, so that a client does not download an unchanged answer again (If-None-Match, RFC 9110, 13.1)."""

import hashlib

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_JSON = "application/json"


def etag(tag: int | str) -> str:
    return f'"{tag}"'


class ConditionalGet:
    """Gives a JSON answer to GET without an ETag the hash of its body.

    Any other ETag names a revision, for `If-Match` of a change, and does not cover the whole body.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] == "GET":
            send = _Answer(Headers(scope=scope).get("if-none-match", ""), send)
        await self._app(scope, receive, send)


class _Answer:
    """Delays the start of an answer until the first part of the body is known."""

    def __init__(self, known: str, send: Send) -> None:
        self._known = {tag.strip().removeprefix("W/") for tag in known.split(",")}
        self._send = send
        self._start: Message | None = None

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start" and _takes_a_tag(message):
            self._start = message
            return
        start, self._start = self._start, None
        if start is not None:
            if not message.get("more_body", False):
                tag = f'"{hashlib.sha256(message["body"]).hexdigest()[:32]}"'
                headers = MutableHeaders(scope=start)
                headers["ETag"] = tag
                if tag in self._known or "*" in self._known:
                    start["status"], message["body"] = 304, b""
                    del headers["Content-Length"], headers["Content-Type"]
            await self._send(start)
        await self._send(message)


def _takes_a_tag(start: Message) -> bool:
    headers = Headers(scope=start)
    return start["status"] == 200 and headers.get("content-type") == _JSON and "etag" not in headers
