"""Check every request before it reaches a route, and report its answer.

Order: rate → block → Host → Origin → tunnel → token → size of the body.

1. A request that fails a check before its body costs no more than reading its headers.
2. Without a token, an unknown path gets the same answer as a known path.
3. A page of another site cannot misuse the browser of a person who can reach the appliance: a foreign name as Host
   (DNS rebinding) and a foreign Origin are rejected, and no CORS header is ever sent.
4. A client that does not read its answer is disconnected.
"""

import asyncio
import ipaddress
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from appliance.api.front.access import Bearer, TokenAuthenticator
from appliance.api.front.journal import Journal
from appliance.api.front.problems import REASON, ProblemError, defect, too_many
from appliance.api.front.rates import Buckets
from appliance.base import clock
from appliance.channel.messages.api import ClientRequest, LongRequest
from appliance.channel.operations import OPERATIONS
from appliance.channel.rest_meaning import is_dry_run
from appliance.configuration.settings import ApiLimits
from appliance.quotas.peers import peer_key
from appliance.signing.request_signing import HEADER

_log = structlog.get_logger()
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_OF_FEATURES = frozenset(operation.open_path for operation in OPERATIONS if operation.open_path)
PUBLIC = _OF_FEATURES | {
    "/healthz", "/readyz", "/v1/healthz", "/v1/readyz", "/v1/openapi.json", "/v1/openapi.html",
    "/v1/enrol", "/v1/revocations", "/v1/authority",
}  # fmt: skip
BEARER = "rosrv.bearer"  # the key of the bearer in a request's scope
_NOT_RECORDED = frozenset({"/healthz", "/readyz", "/v1/healthz", "/v1/readyz"})
_QUESTIONS = frozenset({"/v1/policy/explain", "/v1/policy/test"})  # queries with a body
_BODY_SECONDS = 30.0
_LONGEST_ANONYMOUS_BODY = 1024  # bytes of a body without a token
_LARGER = ": raise api_limits.body_bytes (appliance.yaml) and restart, or load it with rosrv on the appliance's machine"
_REQUEST_BODY = (
    24 << 10
)  # bytes of a body with a host's signing request, or of a feature's call without a token
_RENEWAL = re.compile(r"/v1/hosts/[^/]{1,63}/renew(ed)?")  # for hosts, which their tunnels identify
_IN_TUNNELS = frozenset({"/v1/revocations", "/v1/authority"})
_SEND_SECONDS = 30.0
_LONG_SECONDS = 5.0
_MAX_LONG = 200
_PAGE_SHARE = 10  # the rate limit of the console's files, as a multiple of REST's rate limit
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
}


def is_console(path: str) -> bool:
    return path in ("/", "/console") or path.startswith("/console/")


class RequestGate:
    """Checks requests; `names` are REST's host names, besides addresses."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        limits: ApiLimits,
        doorkeeper: TokenAuthenticator,
        journal: Journal,
        names: Iterable[str],
        tunnels: ipaddress.IPv4Network | None = None,
        networks: Iterable[Network] = (),
    ) -> None:
        """Restrict hosts in `tunnels` that are in none of `networks` to the renewal of their certificates."""
        self._app = app
        self._tunnels = tunnels
        self._networks = tuple(networks)
        self._limits = limits
        self.doorkeeper = doorkeeper
        self._journal = journal
        self._names = {"localhost", *(name.lower() for name in names)}
        self._rate = Buckets(limits.requests_per_second, limits.burst)
        # A page loads many small files at once, and they cost only this process time.
        self._running: dict[_Answer, float] = {}  # since when
        self._page_rate = Buckets(limits.requests_per_second * _PAGE_SHARE, limits.burst * _PAGE_SHARE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        answer = _Answer(scope, send, self._journal, self.doorkeeper)
        gone: asyncio.Future[None] | None = None
        try:
            bearer, body = await self._pass(scope, receive)
            if bearer is not None and bearer.asked is not None:
                gone = asyncio.ensure_future(_disconnected(receive))
                bearer = replace(bearer, gone=gone)
            answer.bearer = scope[BEARER] = bearer
            self._running[answer] = clock.now()
            await self._app(scope, _replay(body, receive), answer.send)
        except ProblemError as problem:
            await answer.fail(problem, receive)
        except (TimeoutError, ConnectionError) as error:
            _log.info(
                "a client was cut off", path=scope["path"], reason=str(error) or "it does not read the answer"
            )
            raise
        except Exception as error:  # noqa: BLE001  a defect in a route must fail only for its client
            _log.exception("a REST call failed", path=scope["path"])
            await answer.fail(defect(error), receive)
        finally:
            self._running.pop(answer, None)
            if gone is not None:
                gone.cancel()

    def long_requests(self) -> list[LongRequest]:
        """Return the requests with a token that run for `_LONG_SECONDS`, such as followers."""
        now = clock.now()
        rows = Counter(
            answer.caller
            for answer, since in self._running.items()
            if now - since >= _LONG_SECONDS and answer.bearer
        )
        return [LongRequest(*caller, count) for caller, count in rows.most_common(_MAX_LONG)]

    def admit_websocket(self, host: str, path: str, credential: str = "") -> None:
        """Check the rate and the tunnel of a WebSocket's request. Raises `ProblemError`."""
        _pay(self._rate, host, credential)
        self.doorkeeper.require_unblocked(host)
        self._check_tunnel(host, path, renewal=False)

    async def _pass(self, scope: Scope, receive: Receive) -> tuple[Bearer | None, bytes]:
        host = scope["client"][0]
        headers = Headers(scope=scope)
        if is_console(scope["path"]):
            _pay(self._page_rate, host)
        else:
            _pay(self._rate, host, self.doorkeeper.recognised(headers.get("authorization")))
        self.doorkeeper.require_unblocked(host)
        self._check_host(headers)
        _check_origin(scope, headers)
        path, bearer = scope["path"], None
        renewal = _RENEWAL.fullmatch(path) is not None
        self._check_tunnel(host, path, renewal=renewal)
        if path not in PUBLIC and not renewal and not is_console(path):
            bearer = await self.doorkeeper.recognise(headers.get("authorization"), host)
        limit, advice = _LONGEST_ANONYMOUS_BODY, ""
        if bearer is not None:
            limit, advice = int(self._limits.body_bytes), _LARGER
        if renewal or path == "/v1/enrol" or path in _OF_FEATURES:
            limit, advice = _REQUEST_BODY, ""
        body = await _read(headers, receive, limit, advice)
        if bearer is not None and scope["method"] != "GET":
            bearer = replace(bearer, asked=asked_of(scope, headers, body))
        return bearer, body

    def _check_tunnel(self, host: str, path: str, *, renewal: bool) -> None:
        address = ipaddress.ip_address(host)
        if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
            address = address.ipv4_mapped
        if self._tunnels is None or address not in self._tunnels or renewal or path in _IN_TUNNELS:
            return
        if not any(address in network for network in self._networks):
            raise ProblemError(
                403,
                "not-from-a-tunnel",
                f"through tunnels REST only renews certificates: add {self._tunnels} to api_networks for more",
            )

    def _check_host(self, headers: Headers) -> None:
        given = headers.getlist("host")
        name = _host_of(given[0]) if len(given) == 1 else None
        if name is None or not (name in self._names or _is_address(name)):
            raise ProblemError(
                421,
                "wrong-host",
                "the appliance does not answer to this host name: use its address, or add the name to api_names",
            )


def _pay(rate: Buckets, host: str, credential: str = "") -> None:
    """Take from the bucket of a known credential at this host, or else from the host's, which its neighbours empty."""
    wait = rate.take(f"{credential} {peer_key(host)}" if credential else host, clock.now())
    if wait:
        raise too_many("too-many-requests", "too many requests from this host", wait)


def asked_of(scope: Scope, headers: Headers, body: bytes) -> ClientRequest:
    """Return the request in the form in which control verifies its signature."""
    query = scope["query_string"].decode("latin-1")
    return ClientRequest(
        host=scope["client"][0],
        method=scope["method"],
        target=scope["raw_path"].decode("latin-1") + (f"?{query}" if query else ""),
        if_match=headers.get("if-match", ""),
        content_type=headers.get("content-type", ""),
        proof=headers.get(HEADER, ""),
        body=body,
    )


class _Answer:
    """An answer, which gets hardening headers and a time limit, and is reported when its status is known."""

    def __init__(self, scope: Scope, send: Send, journal: Journal, doorkeeper: TokenAuthenticator) -> None:
        self.doorkeeper = doorkeeper
        self._scope = scope
        self._send = send
        self._journal = journal
        self._started = clock.now_ns()
        self._begun = self._ended = False
        self.bearer: Bearer | None = None

    @property
    def caller(self) -> tuple[str, str, str]:
        return self._scope["client"][0], self.bearer.name if self.bearer else "", self._scope["path"][:100]

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self._begun = True
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
            self._report(message["status"])
        elif self.bearer is not None and self.doorkeeper.is_blocked(self._scope["client"][0]):
            raise ConnectionAbortedError("this host was blocked by an operator")
        async with asyncio.timeout(_SEND_SECONDS):
            await self._send(message)
        self._ended = message["type"] == "http.response.body" and not message.get("more_body", False)

    async def fail(self, problem: ProblemError, receive: Receive) -> None:
        if self._ended:
            return
        if self._begun:
            raise ConnectionAbortedError(problem.detail)
        self._scope[REASON] = problem.detail
        await problem.response()(self._scope, receive, self.send)

    def _report(self, status: int) -> None:
        path = self._scope["path"]
        if (path in _NOT_RECORDED and status in (200, 304, 503)) or (is_console(path) and status < 400):
            return
        self._journal.answered(
            host=self._scope["client"][0],
            who=self.bearer.name if self.bearer else "",
            method=self._scope["method"],
            path=path,
            status=status,
            reason=self._scope.get(REASON, ""),
            dry=path in _QUESTIONS or is_dry_run(self._scope["query_string"].decode("latin-1")),
            duration_us=(clock.now_ns() - self._started) // 1000,
        )


async def _disconnected(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


def _replay(body: bytes, receive: Receive) -> Receive:
    given = False

    async def next_message() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return next_message


def _host_of(header: str) -> str | None:
    if header.startswith("["):
        name, bracket, rest = header[1:].partition("]")
        return name if bracket and (not rest or rest.startswith(":")) else None
    return header.partition(":")[0].rstrip(".").lower() or None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _check_origin(scope: Scope, headers: Headers) -> None:
    origin = headers.get("origin")
    if origin is not None and origin.lower() != f"{scope['scheme']}://{headers['host']}".lower():
        raise ProblemError(403, "foreign-origin", "requests from pages of other sites are not served")


async def _read(headers: Headers, receive: Receive, limit: int, advice: str) -> bytes:
    too_large = ProblemError(
        413, "too-large", f"the body is larger than {limit} bytes{advice}", headers={"Connection": "close"}
    )
    length = headers.get("content-length", "0")
    if not length.isdigit() or int(length) > limit:
        raise too_large
    body = bytearray()
    try:
        async with asyncio.timeout(_BODY_SECONDS):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    raise ConnectionResetError("the client went away")
                body += message.get("body", b"")
                if len(body) > limit:
                    raise too_large
                if not message.get("more_body", False):
                    return bytes(body)
    except TimeoutError:
        raise ProblemError(
            408,
            "too-slow",
            f"the body did not arrive within {_BODY_SECONDS:g} s",
            headers={"Connection": "close"},
        ) from None
