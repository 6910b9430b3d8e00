import contextlib
import http.client
import json
import ssl
import threading
import time
import urllib.parse
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.processes import LIMIT


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def etag(self) -> str:
        return self.headers["etag"]


class Rest:
    """Makes requests, each on a new connection.

    After a 429, it repeats the request when the server allows it, because requests of other tests to a shared
    appliance must not fail this test. `impatient()` does not wait.
    """

    def __init__(
        self, url: str, token: str | None = None, certificate: Path | None = None, *, patient: bool = True
    ) -> None:
        self.url = urllib.parse.urlsplit(url)
        self.token = token
        self.certificate = certificate
        self.patient = patient

    def with_token(self, token: str | None) -> "Rest":
        return Rest(self.url.geturl(), token, self.certificate, patient=self.patient)

    def impatient(self) -> "Rest":
        return Rest(self.url.geturl(), self.token, self.certificate, patient=False)

    def connect(self, timeout: float = 30, source: str = "") -> http.client.HTTPConnection:
        assert self.url.hostname is not None
        local = (source, 0) if source else None
        if self.url.scheme == "http":
            return http.client.HTTPConnection(
                self.url.hostname, self.url.port, timeout=timeout, source_address=local
            )
        context = ssl.create_default_context(cafile=self.certificate)
        return http.client.HTTPSConnection(
            self.url.hostname, self.url.port, timeout=timeout, context=context, source_address=local
        )

    def headers(self, given: dict[str, str] | None = None) -> dict[str, str]:
        known = {"Authorization": f"Bearer {self.token}"} if self.token is not None else {}
        return known | (given or {})

    def request(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
        timeout: float = 30,
    ) -> Answer:
        with self._asked(method, path, body, headers, timeout) as response:
            names = {name.lower(): value for name, value in response.getheaders()}
            return Answer(response.status, names, response.read())

    @contextlib.contextmanager
    def _asked(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str] | None, timeout: float = 30
    ) -> Iterator[http.client.HTTPResponse]:
        begun = time.monotonic()
        while True:
            connection = self.connect(timeout)
            try:
                connection.request(method, path, body, self.headers(headers))
                response = connection.getresponse()
                if response.status != 429 or not self.patient or time.monotonic() > begun + LIMIT:
                    yield response
                    return
            finally:
                connection.close()
            threading.Event().wait(float(response.headers["Retry-After"]))

    def get(self, path: str, **headers: str) -> Answer:
        return self.request(
            "GET", path, None, {name.replace("_", "-"): text for name, text in headers.items()}
        )

    def post(self, path: str, body: Any = None, *, match: str | None = None) -> Answer:
        """Send a string as text/plain, anything else as JSON. `match` is the header If-Match."""
        headers = {} if match is None else {"If-Match": match}
        if isinstance(body, str):
            return self.request("POST", path, body.encode(), headers | {"Content-Type": "text/plain"})
        headers["Content-Type"] = "application/json"
        return self.request("POST", path, None if body is None else json.dumps(body).encode(), headers)

    def events(self, path: str, timeout: float = 30, **headers: str) -> Generator[dict[str, str], None, None]:
        """Yield events, after `{}` for the open stream. Wait for each at most `timeout` seconds.

        The appliance's pings keep a stream open, but must not keep a test waiting.
        """
        given = {name.replace("_", "-"): text for name, text in headers.items()}
        with self._asked("GET", path, None, given, timeout) as response:
            assert response.status == 200, response.read()
            yield {}
            event: dict[str, str] = {}
            deadline = time.monotonic() + timeout
            while line := response.readline():
                text = line.decode().rstrip("\r\n")
                if not text and event:
                    yield event
                    event = {}
                    deadline = time.monotonic() + timeout
                assert time.monotonic() < deadline, f"no event of {path} within {timeout} seconds"
                if text and not text.startswith(":"):
                    name, _colon, value = text.partition(": ")
                    event[name] = value
