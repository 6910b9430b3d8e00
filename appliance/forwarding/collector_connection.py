"""Speak to the collector over HTTPS with a client certificate. Every wait has a limit."""

import http.client
import ssl
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Protocol

import msgspec

from appliance.signing.receipts import SegmentReceipt

_SECONDS = 30.0
_LARGEST_ANSWER = 65_536


class CollectorRefusedError(OSError):
    """The collector refuses a request. `wait` is the number of seconds that it asks for; 0: none."""

    def __init__(self, reason: str, wait: float = 0.0) -> None:
        super().__init__(reason)
        self.wait = wait


class StoredHead(msgspec.Struct, frozen=True):
    """The collector's newest checkpoint of a log: its number (0: none), and the hashes of those with this number."""

    robot: str
    log: str
    number: int
    hashes: list[str]


class CollectorLink(Protocol):
    """The requests to a collector. Each raises `OSError`, and `ValueError` for an invalid answer."""

    def head(self, log: str, upto: int) -> StoredHead:
        """Return the newest stored checkpoint of a log up to number `upto`."""

    def push(self, log: str, number: int, name: str, body: IO[bytes], size: int) -> SegmentReceipt:
        """Send a segment of `size` compressed bytes; return the receipt, whose signature is not checked yet."""

    def close(self) -> None:
        """Close the connection, if there is one."""


class _NamedConnection(http.client.HTTPSConnection):
    """A connection to a server whose certificate has the name `server`."""

    def __init__(self, place: tuple[str, int], server: str, context: ssl.SSLContext) -> None:
        super().__init__(*place, timeout=_SECONDS, context=context)
        self._tls, self._server = context, server

    def connect(self) -> None:
        http.client.HTTPConnection.connect(self)
        self.sock = self._tls.wrap_socket(self.sock, server_hostname=self._server)


class HttpsCollector:
    """The collector at an address; `context` makes the TLS context of each connection.

    `name` is the name in the collector's certificate (None: the address).
    """

    def __init__(
        self, host: str, port: int, context: Callable[[], ssl.SSLContext], name: str | None = None
    ) -> None:
        self._place = (host, port)
        self._name = name or host
        self._context = context
        self._connection: http.client.HTTPSConnection | None = None

    def head(self, log: str, upto: int) -> StoredHead:
        """Return the newest stored checkpoint of a log up to number `upto`."""
        return msgspec.json.decode(self._ask("GET", f"/v1/logs/{log}?upto={upto}"), type=StoredHead)

    def push(self, log: str, number: int, name: str, body: IO[bytes], size: int) -> SegmentReceipt:
        """Send a segment; return the receipt."""
        answer = self._ask("PUT", f"/v1/logs/{log}/segments/{number}/{name}", body, size)
        return msgspec.json.decode(answer, type=SegmentReceipt)

    def _ask(self, method: str, path: str, body: IO[bytes] | None = None, size: int = 0) -> bytes:
        connection = self._connection
        if connection is None:
            connection = _NamedConnection(self._place, self._name, self._context())
            self._connection = connection
        headers = {} if body is None else {"Content-Length": str(size), "Content-Encoding": "gzip"}
        try:
            # A collector that refuses early closes while the body is sent: its answer has the reason.
            with suppress(BrokenPipeError, ConnectionResetError):
                connection.request(method, path, body, headers)
            response = connection.getresponse()
            answer = response.read(_LARGEST_ANSWER)
        except http.client.HTTPException as error:
            self.close()
            raise ConnectionError(
                f"the collector does not answer HTTP: {error or type(error).__name__}"
            ) from error
        except BaseException:
            self.close()
            raise
        if not response.isclosed() or response.will_close:
            self.close()
        if response.status not in (200, 201):
            wait = response.headers.get("Retry-After", "")
            detail = answer.decode("utf-8", "replace")[:500]
            raise CollectorRefusedError(
                f"the collector answers {response.status}: {detail}", float(wait) if wait.isdecimal() else 0.0
            )
        return answer

    def close(self) -> None:
        """Close the connection, if there is one."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def https_collector(
    address: tuple[str, int], ca: Path, certificate: Path, key: Path, name: str | None = None
) -> HttpsCollector:
    """Return the collector at an address; files are read for each connection, so that replaced ones apply."""

    def context() -> ssl.SSLContext:
        try:
            made = ssl.create_default_context(cafile=ca)
            made.minimum_version = ssl.TLSVersion.TLSv1_3
            made.load_cert_chain(certificate, key)
        except OSError as error:
            raise OSError(f"{ca}, {certificate}, {key}: cannot be read: {error.strerror or error}") from error
        return made

    return HttpsCollector(*address, context, name)
