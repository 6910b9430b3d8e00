"""Send requests to the running appliance over REST.

1. A credential leaves this machine only encrypted, to a server whose certificate is trusted (`--api-ca`, else the
   system's authorities). This check cannot be switched off. Clear text is used only for loopback addresses.
2. The token comes from the environment, never from the command line, which every user of the machine can see.
   Only its reading key is sent, and each order is signed (`request_signing.py`).
3. Redirects, proxies and credentials from `.netrc` are not used.
"""

import json
import ssl
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx

from appliance.base.input_files import read_given_text
from appliance.base.system_errors import without_number
from appliance.cli.connection.admin_client import (
    SECONDS,
    UNKNOWN,
    AccessDeniedError,
    NotRunningError,
    RestProblemError,
)
from appliance.configuration.sections import is_loopback
from appliance.signing.request_signing import HEADER, proof_of, reading_key, statement
from appliance.store.access_tokens import parse_token

_CONNECT_SECONDS = 10.0
_LONGEST_ERROR = 1 << 20
_MAKE = "make one on its machine: rosrv token add NAME"


class RestClient:
    """A client of REST; the methods raise `NotRunningError` and `RestProblemError`."""

    def __init__(
        self,
        url: str,
        token: str | None,
        ca_file: Path | None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        """Raises `ValueError` if a token must not be sent to this URL. The default transport is the network."""
        self.url, secure = _place_of(url)
        self._token = _check_token(token)
        if ca_file is not None and not secure:
            raise ValueError(f"--api-ca is for https, but {self.url} is clear text")
        self._client = httpx.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {reading_key(self._token)}", "User-Agent": "rosrv"},
            verify=_context(ca_file) if secure else False,
            timeout=httpx.Timeout(SECONDS, connect=_CONNECT_SECONDS),
            trust_env=False,
            follow_redirects=False,
            transport=transport,
        )

    def close(self) -> None:
        self._client.close()

    def call(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        body: object = None,
        seconds: float | None = SECONDS,
        match: bool = False,
        order: bool = True,
    ) -> dict[str, Any]:
        """Return the answer's object. `match`: accept any present revision (`If-Match: *`).

        An `order` is signed unless it is a GET; a dry run is not an order.
        """
        headers = {"If-Match": "*"} if match else {}
        with self.stream(
            method, path, params=params, body=body, seconds=seconds, headers=headers, order=order
        ) as answer:
            text = answer.read()
        try:
            found = json.loads(text)
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise NotRunningError(
                f"{self.url} is not an appliance's REST API: its answer is not a JSON object"
            )
        return found

    @contextmanager
    def stream(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        body: object = None,
        seconds: float | None = SECONDS,
        headers: Mapping[str, str] | None = None,
        order: bool = True,
    ) -> Iterator[httpx.Response]:
        signed = order and method != "GET"
        challenge = str(self.call("GET", "/v1/challenge").get("challenge", "")) if signed else ""
        request = self._client.build_request(
            method,
            path,
            params=params,
            json=body,
            headers=headers,
            timeout=httpx.Timeout(seconds, connect=_CONNECT_SECONDS),
        )
        if challenge:
            request.headers[HEADER] = proof_of(self._token, challenge, _stated(request, challenge))
        try:
            with closing(self._client.send(request, stream=True)) as answer:
                if answer.status_code not in (httpx.codes.OK, httpx.codes.CREATED):
                    raise self._problem(answer)
                yield answer
        except httpx.ConnectError as error:
            raise NotRunningError(self._why_not_connected(error)) from None
        except httpx.TimeoutException:
            raise NotRunningError(
                f"{self.url}: no answer in time; is the appliance running there?{_unknown(method)}"
            ) from None
        except httpx.HTTPError as error:
            raise NotRunningError(
                f"{self.url}: the connection broke: {without_number(error)}{_unknown(method)}"
            ) from None

    def _why_not_connected(self, error: Exception) -> str:
        text = without_number(error)
        if "CERTIFICATE_VERIFY_FAILED" in text:
            if "mismatch" in text or "not valid for" in text:
                return (
                    f"{self.url}: its certificate is not for this name or address: use one that it lists (api_names "
                    "in appliance.yaml adds names)"
                )
            why = "has expired" if "expired" in text else "is not trusted"
            return (
                f"{self.url}: its certificate {why}: print it there (rosrv certificate) and give "
                "it with --api-ca FILE"
            )
        if "SSL" in text:
            return f"{self.url}: does not speak TLS as expected ({text}); is it http instead of https?"
        return (
            f"{self.url} cannot be reached: {text}; is the appliance running there, and may this machine connect "
            "(api, api_networks in appliance.yaml)?"
        )

    def _problem(self, answer: httpx.Response) -> Exception:
        answer.read()
        try:
            problem = json.loads(answer.content[:_LONGEST_ERROR])
            kind, detail = str(problem["type"]).removeprefix("urn:rosrv:problem:"), str(problem["detail"])
        except (ValueError, KeyError, TypeError, RecursionError):
            return NotRunningError(
                f"{self.url} is not an appliance's REST API: it answers with status {answer.status_code}"
            )
        wait = answer.headers.get("Retry-After")
        match answer.status_code:
            case 401:
                return AccessDeniedError(
                    f"{self.url}: the token in ROSRV_TOKEN is not accepted: {detail}; {_MAKE}"
                )
            case 403 | 421:
                return AccessDeniedError(f"{self.url}: {detail}")
            case 429 | 503 if wait is not None and kind != "standby":
                return NotRunningError(f"{self.url}: {detail}; try again in {wait} s")
        if kind == "unknown-path":
            return NotRunningError(
                f"{self.url}: this appliance's version does not offer that over REST: run this on its machine"
            )
        return RestProblemError(answer.status_code, kind, detail.split("\n"), problem.get("findings"))


def _unknown(method: str) -> str:
    return "" if method == "GET" else f"; {UNKNOWN}"


def _stated(request: httpx.Request, challenge: str) -> bytes:
    return statement(
        challenge,
        method=request.method,
        target=request.url.raw_path.decode("ascii"),
        if_match=request.headers.get("If-Match", ""),
        content_type=request.headers.get("Content-Type", ""),
        body=request.content,
    )


def _place_of(url: str) -> tuple[str, bool]:
    """Return scheme, host and port, and whether the scheme is encrypted. Raises `ValueError`."""
    try:
        parts = urlsplit(url)
        host, _port = parts.hostname, parts.port
    except ValueError:
        host = None
    if host is None or parts.scheme not in ("http", "https"):
        raise ValueError(f"--api {url!r} is not a URL: write https://HOST:PORT, as `rosrv up` prints it")
    if parts.username is not None or parts.path.strip("/") or parts.query or parts.fragment:
        raise ValueError(f"--api {url!r}: write scheme, host and port only: {parts.scheme}://HOST:PORT")
    if parts.scheme == "http" and not is_loopback(host):
        raise ValueError(f"--api {url!r} would send the token in clear text: use https")
    return f"{parts.scheme}://{parts.netloc}", parts.scheme == "https"


def _check_token(token: str | None) -> str:
    text = (token or "").strip()
    if not text:
        raise ValueError(f"no access token: put it into the environment as ROSRV_TOKEN; {_MAKE}")
    if parse_token(text) is None:
        raise ValueError(f"ROSRV_TOKEN is not an access token; {_MAKE}")
    return text


def _context(ca_file: Path | None) -> ssl.SSLContext:
    try:
        if ca_file is None:
            return ssl.create_default_context()
        # An empty string would select the system's authorities.
        text = read_given_text(ca_file, "ascii", "ignore") or "no certificate"
        return ssl.create_default_context(cadata=text)
    except ssl.SSLError:
        raise ValueError(f"--api-ca {ca_file}: has no certificate in PEM") from None
    except OSError as error:
        raise ValueError(f"--api-ca {ca_file}: {error.strerror}") from None
