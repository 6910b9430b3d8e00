"""Connect to the collector over HTTPS with the robot's certificate. The collector and the network are not trusted.

1. Requests go only to the configured collector. httpcore follows no redirect, uses no proxy and expands nothing.
2. An exchange has one deadline for all its parts. Answers have a size limit, and compressed ones are rejected.
3. Each new connection reads the certificate files again, so replaced files apply.
"""

import ssl
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import httpcore
import msgspec

from appliance.audit.log.record_format import printable
from appliance.base import clock
from appliance.base.input_files import path_for_library, read_given
from appliance.base.system_errors import without_number
from appliance.signing.own_certificate import untimely

_EXCHANGE_SECONDS = 60.0  # a collector answers late when a thousand robots ask at once
_SILENT_SECONDS = 90.0  # the collector sends a comment on the event stream every 30 s
_SLOWEST_UPLOAD = 16_384  # bytes per second
_PART = 16_384  # of a write: the deadline is checked between the parts
_LARGEST_ANSWER = 65_536
_LONGEST_TAG = 200
_LONGEST_CERTIFICATE = 1 << 20
_LONGEST_REASON = 500
_LONGEST_REFUSAL = 16_384  # bytes of the answer that has the reason
_NOT_MODIFIED = 304
_EXPECTED = (200, 201, 204)
_UNTIMELY = (9, 10)  # OpenSSL: a certificate is not yet valid, or has expired
_FAILURES = (httpcore.TimeoutException, httpcore.NetworkError, httpcore.ProtocolError, OSError)


class CollectorError(Exception):
    """The collector gave no usable answer."""

    def __init__(self, reason: str, status: int | None = None, wait: float = 0.0) -> None:
        super().__init__(reason)
        self.status = status
        self.wait = wait  # seconds that the collector asks for; 0: none


class _Refusal(msgspec.Struct, frozen=True):
    detail: str


class ConditionalAnswer(NamedTuple):
    """An answer with its entity tag, which the next request for it repeats."""

    tag: bytes
    body: bytes


class CollectorConnection:
    """A connection, opened when it is needed. Not thread-safe. Methods raise `CollectorError`."""

    def __init__(self, url: str, context: Callable[[], ssl.SSLContext], name: str | None = None) -> None:
        """`url` is `https://ADDRESS:PORT`, `name` the name in the collector's certificate (None: the address)."""
        self.url = url
        self._context = context
        self._known: dict[str, ConditionalAnswer] = {}
        self._extensions = {} if name is None else {"sni_hostname": name}
        self._headers = [("Host", url.partition("//")[2]), ("Accept-Encoding", "identity")]
        self._deadline = _Deadline()
        self._connection: httpcore.HTTPConnection | None = None

    def get(self, path: str, longest: int = _LARGEST_ANSWER) -> bytes:
        return b"".join(self.chunks(path, longest))

    def get_changed(self, path: str, longest: int) -> bytes:
        known = self._known.get(path)
        headers = [] if known is None else [("If-None-Match", known.tag)]
        with self._exchange("GET", path, headers) as answer:
            if known is not None and answer.status == _NOT_MODIFIED:
                return known.body
            body = b"".join(_bounded(path, answer, longest))
            tag = _header(answer, b"etag")
            if tag and len(tag) < _LONGEST_TAG:
                self._known[path] = ConditionalAnswer(tag, body)
            return body

    def chunks(self, path: str, longest: int) -> Iterator[bytes]:
        with self._exchange("GET", path) as answer:
            yield from _bounded(path, answer, longest)

    def put(
        self, path: str, content: Iterator[bytes], size: int, headers: Iterable[tuple[str, str]] = ()
    ) -> bytes:
        sent = [("Content-Length", str(size)), *headers]
        with self._exchange("PUT", path, sent, content, size) as answer:
            return b"".join(_bounded(path, answer, _LARGEST_ANSWER))

    def post(self, path: str, body: bytes) -> bytes:
        sent = [("Content-Length", str(len(body)))]
        with self._exchange("POST", path, sent, iter((body,)), len(body)) as answer:
            return b"".join(_bounded(path, answer, _LARGEST_ANSWER))

    def events(self, path: str) -> Iterator[bytes]:
        """Yield the parts of an event stream until it ends or is silent."""
        with self._exchange("GET", path, [("Accept", "text/event-stream")]) as answer:
            self._deadline.begin(_SILENT_SECONDS)
            for part in _check(path, answer).iter_stream():
                yield part
                self._deadline.begin(_SILENT_SECONDS)

    @property
    def is_open(self) -> bool:
        connection = self._connection
        return connection is not None and connection.is_available() and not connection.has_expired()

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    @contextmanager
    def _exchange(
        self,
        method: str,
        path: str,
        headers: Iterable[tuple[str, str | bytes]] = (),
        content: Iterator[bytes] | None = None,
        size: int = 0,
    ) -> Iterator[httpcore.Response]:
        self._deadline.begin(_EXCHANGE_SECONDS + size / _SLOWEST_UPLOAD)
        sent: Any = [*self._headers, *headers]  # httpcore takes text and bytes, but its types say one of them
        url = f"{self.url}/{path}"
        try:
            with self._connect().stream(
                method, url, headers=sent, content=content, extensions=self._extensions
            ) as answer:
                yield answer
        except _FAILURES as error:
            reason, cause = without_number(error) or "the connection ended", error.__cause__
            if isinstance(error, httpcore.TimeoutException):
                reason = f"the collector takes more than {self._deadline.seconds:g} s"
            elif isinstance(cause, ssl.SSLCertVerificationError) and cause.verify_code in _UNTIMELY:
                reason += f"; the clock of this machine shows {clock.utc_now():%Y-%m-%d %H:%M} UTC"
            elif isinstance(error, httpcore.RemoteProtocolError) or "alert" in reason:
                reason += (
                    "; if it answers other robots, it rejects this certificate: see 'rosrv-fleet robot list', and"
                    " compare the clocks"
                )
            raise CollectorError(f"{self.url}/{path.partition('?')[0]}: {reason}") from error

    def _connect(self) -> httpcore.HTTPConnection:
        if self._connection is None or not self.is_open:
            self.close()
            self._connection = httpcore.HTTPConnection(
                httpcore.URL(self.url).origin, self._context(), network_backend=_Network(self._deadline)
            )
        return self._connection


class _Deadline:
    def __init__(self) -> None:
        self.seconds = 0.0
        self._end = 0.0

    def begin(self, seconds: float) -> None:
        self.seconds = seconds
        self._end = clock.now() + seconds

    def remaining(self) -> float:
        left = self._end - clock.now()
        if left <= 0:
            raise httpcore.TimeoutException
        return left


class _Network(httpcore.NetworkBackend):
    def __init__(self, deadline: _Deadline) -> None:
        self._deadline = deadline

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,  # noqa: ARG002  the deadline counts
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.NetworkStream:
        stream = httpcore.SyncBackend().connect_tcp(
            host, port, self._deadline.remaining(), local_address, socket_options
        )
        return _Stream(stream, self._deadline)


class _Stream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream, deadline: _Deadline) -> None:
        self._stream = stream
        self._deadline = deadline

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:  # noqa: ARG002  the deadline counts
        return self._stream.read(max_bytes, self._deadline.remaining())

    def write(self, buffer: bytes, timeout: float | None = None) -> None:  # noqa: ARG002  the deadline counts
        for start in range(0, len(buffer), _PART):
            self._stream.write(buffer[start : start + _PART], self._deadline.remaining())

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self,
        ssl_context: ssl.SSLContext,
        server_hostname: str | None = None,
        timeout: float | None = None,  # noqa: ARG002  the deadline counts
    ) -> httpcore.NetworkStream:
        try:
            left = self._deadline.remaining()
        except httpcore.TimeoutException:
            self.close()  # as httpcore's own streams do when the handshake fails
            raise
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, left), self._deadline)

    def get_extra_info(self, info: str) -> object:
        return self._stream.get_extra_info(info)


def _bounded(path: str, answer: httpcore.Response, longest: int) -> Iterator[bytes]:
    size = 0
    for part in _check(path, answer).iter_stream():
        size += len(part)
        if size > longest:
            raise CollectorError(
                f"{path}: the answer has more than {longest} bytes: check that fleet.collector is the address of"
                " rosrv-fleet"
            )
        yield part


def _check(path: str, answer: httpcore.Response) -> httpcore.Response:
    if _header(answer, b"content-encoding") not in (b"", b"identity"):
        raise CollectorError(
            f"{path}: the answer is compressed: a proxy before the collector must not do that"
        )
    if answer.status in _EXPECTED:
        return answer
    refusal = b""
    for part in answer.iter_stream():
        refusal += part
        if len(refusal) > _LONGEST_REFUSAL:
            break
    wait = _header(answer, b"retry-after")
    raise CollectorError(
        f"the collector answers {answer.status}: {reason_in(refusal)}",
        answer.status,
        float(wait) if wait.isdigit() else 0.0,
    )


def reason_in(refusal: bytes) -> str:
    """Return the reason of a refusal in printable characters: a collector's `detail`, or the body of another server."""
    try:
        text = msgspec.json.decode(refusal[:_LONGEST_REFUSAL], type=_Refusal).detail
    except ValueError:
        text = refusal.decode("utf-8", "replace").strip() or "no reason"
    return printable(text[:_LONGEST_REASON])


def _header(answer: httpcore.Response, name: bytes) -> bytes:
    return next((value for key, value in answer.headers if key.lower() == name), b"")


def trusting_context(ca: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        with path_for_library(ca) as authority:
            context.load_verify_locations(authority)
    except OSError as error:
        raise OSError(error.errno, f"cannot be used: {error.strerror or error}", str(ca)) from error
    return context


def robot_context(ca: Path, certificate: Path, key: Path) -> ssl.SSLContext:
    context = trusting_context(ca)
    try:
        with path_for_library(certificate) as chain, path_for_library(key) as private:
            context.load_cert_chain(chain, private)
    except OSError as error:
        lost = error.filename or str(certificate)
        raise OSError(error.errno, f"cannot be used: {error.strerror or error}", lost) from error
    fault = untimely(read_given(certificate, _LONGEST_CERTIFICATE), "this machine")
    if fault:
        raise CollectorError(
            f"{certificate}: {fault}: correct the clock, or join again with a new invitation"
        )
    return context


def robot_connection(
    url: str, ca: Path, certificate: Path, key: Path, name: str | None = None
) -> CollectorConnection:
    return CollectorConnection(url, lambda: robot_context(ca, certificate, key), name)
