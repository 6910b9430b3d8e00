"""The client of REST, with a server in memory."""

import json
from collections.abc import Callable, Iterable, Iterator

import httpx

from appliance.cli.connection.rest_session import RestClient
from tests.support.fake_appliance import TOKEN

URL = "http://127.0.0.1:8443"


def rest_client(answer: Callable[[httpx.Request], httpx.Response]) -> RestClient:
    return RestClient(URL, TOKEN, None, transport=httpx.MockTransport(answer))


def problem(status: int, kind: str, detail: str) -> httpx.Response:
    return httpx.Response(status, json={"type": f"urn:rosrv:problem:{kind}", "detail": detail})


def stream(lines: Iterable[str], *, breaks: bool = False) -> httpx.Response:
    """Return an answer with these lines, after which the connection may break."""

    def sent() -> Iterator[bytes]:
        for line in lines:
            yield f"{line}\n".encode()
        if breaks:
            raise httpx.ReadError("cut")

    return httpx.Response(200, content=sent())


def page(records: Iterable[str], cursor: str | None = None) -> httpx.Response:
    """Return an answer with a page of the audit log, whose records are JSON."""
    return httpx.Response(200, json={"records": [json.loads(record) for record in records], "cursor": cursor})
