"""Connect to the collector over HTTPS with the robot's certificate. Every answer has a size limit and a time limit.

Invariants:
1. Only the configured collector is asked: no redirect, no proxy, no other host.
2. An exchange ends after `_EXCHANGE_SECONDS`, even if the collector sends a byte now and then.
3. An answer beyond its size limit is discarded. Compressed answers are not requested, and rejected.
"""

import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import httpx

_EXCHANGE_SECONDS = 60.0
_TIMEOUT = httpx.Timeout(30.0)  # a collector answers late when a thousand robots ask at once
_SILENT_SECONDS = 90.0  # the collector sends a comment on the event stream every 30 s
_CHUNK = 65_536
_LONGEST_TAG = 200
_NOT_MODIFIED = 304
_OK = 200


class CollectorError(Exception):
    """The collector is unreachable or gave no usable answer. `status` is its HTTP status, or None."""

    def __init__(self, reason: str, status: int | None = None) -> None:
        super().__init__(reason)
        self.status = status


class ConditionalAnswer(NamedTuple):
    """An answer that is asked for again with its entity tag."""

    tag: str
    body: bytes


class CollectorConnection:
    """A connection to one collector. Not thread-safe, except `close`."""

    def __init__(
        self, url: str, context: ssl.SSLContext, name: str | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`url` is `https://ADDRESS:PORT`. `name` is the name in the collector's certificate (None: the address)."""
        self.url = url.rstrip("/")
        self._clock = clock
        self._known: dict[str, ConditionalAnswer] = {}
        self._extensions = {} if name is None else {"sni_hostname": name}
        self._client = httpx.Client(
            verify=context, timeout=_TIMEOUT, trust_env=False, follow_redirects=False, http2=False
        )

    def get(self, path: str, longest: int) -> bytes:
        """Return the body at a path. Raises `CollectorError`."""
        return b"".join(self.chunks(f"{self.url}/{path}", longest))

    def get_changed(self, path: str, longest: int) -> bytes:
        """Return the body at a path; ask with its entity tag if it is known. Raises `CollectorError`."""
        known = self._known.get(path)
        headers = {} if known is None else {"If-None-Match": known.tag}
        with self._answer("GET", f"{self.url}/{path}", headers) as answer:
            if known is not None and answer.status_code == _NOT_MODIFIED:
                return known.body
            body = b"".join(self._bounded(answer, longest))
            tag = answer.headers.get("ETag", "")
            if tag and len(tag) < _LONGEST_TAG:
                self._known[path] = ConditionalAnswer(tag, body)
            return body

    def chunks(self, url: str, longest: int) -> Iterator[bytes]:
        """Yield the body at a URL of the collector in parts. Raises `CollectorError`."""
        with self._answer("GET", url, {}) as answer:
            yield from self._bounded(answer, longest)

    def put(self, path: str, body: bytes) -> None:
        """Send a JSON document. Raises `CollectorError`."""
        headers = {"Content-Type": "application/json"}
        with self._answer("PUT", f"{self.url}/{path}", headers, body) as answer:
            for _part in self._bounded(answer, _CHUNK, statuses=(200, 204)):
                pass

    def events(self, path: str) -> Iterator[bytes]:
        """Yield parts of an event stream until it ends. Raises `CollectorError` also if it is silent."""
        headers = {"Accept": "text/event-stream"}
        timeout = httpx.Timeout(30.0, read=_SILENT_SECONDS)
        with self._answer("GET", f"{self.url}/{path}", headers, timeout=timeout) as answer:
            if answer.status_code != _OK:
                raise CollectorError(
                    f"{path}: the collector answers {answer.status_code}", answer.status_code
                )
            try:
                yield from answer.iter_raw()
            except httpx.HTTPError as error:
                raise CollectorError(f"{path}: {_reason(error)}") from error

    def close(self) -> None:
        """Close all connections."""
        self._client.close()

    @contextmanager
    def _answer(
        self,
        method: str,
        url: str,
        headers: dict[str, str],
        body: bytes | None = None,
        timeout: httpx.Timeout = _TIMEOUT,
    ) -> Iterator[httpx.Response]:
        asked = {"Accept-Encoding": "identity", **headers}
        request = self._client.build_request(
            method, url, headers=asked, content=body, extensions=self._extensions, timeout=timeout
        )
        try:
            answer = self._client.send(request, stream=True)
        except (httpx.HTTPError, ssl.SSLError, OSError) as error:
            raise CollectorError(f"{self.url} is unreachable: {_reason(error)}") from error
        try:
            yield answer
        finally:
            answer.close()

    def _bounded(
        self, answer: httpx.Response, longest: int, statuses: tuple[int, ...] = (_OK,)
    ) -> Iterator[bytes]:
        path, deadline = answer.request.url.path, self._clock() + _EXCHANGE_SECONDS
        if answer.status_code not in statuses:
            raise CollectorError(f"{path}: the collector answers {answer.status_code}", answer.status_code)
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            raise CollectorError(f"{path}: the collector compresses its answer")
        size = 0
        try:
            for part in answer.iter_raw():
                size += len(part)
                if size > longest:
                    raise CollectorError(f"{path}: the answer has more than {longest} bytes")
                if self._clock() > deadline:
                    raise CollectorError(f"{path}: the answer takes more than {_EXCHANGE_SECONDS:g} s")
                yield part
        except (httpx.HTTPError, ssl.SSLError, OSError) as error:
            raise CollectorError(f"{path}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return str(error) or "the connection ended"


def robot_context(ca: Path, certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the TLS context of a robot: it trusts only `ca`, and presents `certificate`. Raises `OSError`."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_verify_locations(ca)
    except OSError as error:
        raise OSError(error.errno, f"cannot be used: {error.strerror or error}", str(ca)) from error
    try:
        context.load_cert_chain(certificate, key)
    except OSError as error:
        raise OSError(error.errno, f"cannot be used: {error.strerror or error}", str(certificate)) from error
    return context
