"""Sign on over REST as a browser does, at an independent provider (oidc-provider-mock, over TLS)."""

import base64
import contextlib
import secrets
import socket
import socketserver
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import httpx
import oidc_provider_mock  # type: ignore[import-untyped]  # it has no types
import pytest

from appliance.signing.request_signing import keys_of, reading_key
from tests.support.appliance import Appliance
from tests.support.certificates import Certificates, make_certificates
from tests.support.waiting import eventually

# The provider, in a thread of the test, uses functions that its library will remove.
pytestmark = pytest.mark.filterwarnings("ignore")
USERS: dict[str, dict[str, Any]] = {
    "alice": {"groups": ["crew"], "email": "alice@example.org", "email_verified": True},
    "mallory": {"groups": ["strangers"]},
}


NAME = "logs.example"  # no name is looked up: only the certificate has it


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return make_certificates(tmp_path_factory.mktemp("provider") / "tls")


@pytest.fixture(scope="module")
def provider(certificates: Certificates) -> Iterator[int]:
    users = [oidc_provider_mock.User(sub=name, claims=claims) for name, claims in USERS.items()]
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates.certificate, certificates.key)
    with oidc_provider_mock.run_server_in_thread(user_claims=users) as server:
        server.ssl_context = context  # its answers have https URLs
        server.socket = context.wrap_socket(server.socket, server_side=True)
        yield server.server_port


class Proxy(socketserver.ThreadingTCPServer):
    daemon_threads = True

    def __init__(self) -> None:
        self.connected: list[str] = []
        super().__init__(("127.0.0.1", 0), _Tunnel)


class _Tunnel(socketserver.StreamRequestHandler):
    server: Proxy

    def handle(self) -> None:
        method, place, _version = self.rfile.readline().decode().split()
        while self.rfile.readline().strip():
            pass
        self.server.connected.append(f"{method} {place}")
        with socket.create_connection(("127.0.0.1", int(place.rpartition(":")[2]))) as upstream:
            self.wfile.write(b"HTTP/1.1 200 OK\r\n\r\n")
            threading.Thread(target=_copy, args=(upstream, self.connection), daemon=True).start()
            _copy(self.connection, upstream)


def _copy(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            target.sendall(data)
        target.shutdown(socket.SHUT_WR)


@pytest.fixture
def proxy() -> Iterator[Proxy]:
    with Proxy() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def way(provider: int) -> str:
    return f"address: 127.0.0.1:{provider}"


@pytest.fixture
def running(provider: int, way: str, certificates: Certificates, tmp_path: Path) -> Iterator[Appliance]:
    (tmp_path / "secret").write_text("s3:cret/+\n")
    (tmp_path / "ca.pem").write_bytes(certificates.ca.read_bytes())
    settings = f"""
sso:
  issuer: https://{NAME}:{provider}
  {way}
  ca: {tmp_path / "ca.pem"}
  client_id: rosrv
  client_secret_file: {tmp_path / "secret"}
  url: https://127.0.0.1:8443
  roles: {{operator: [crew]}}
  doors: {{floor: [crew]}}
"""
    with Appliance(settings=settings, options=("--api", "127.0.0.1:0")) as appliance:
        yield appliance


class Browser:
    def __init__(self, appliance: Appliance) -> None:
        self.token = f"rosrv_{secrets.token_hex(6)}_{secrets.token_urlsafe(32)}"
        self.rest = httpx.Client(base_url=str(appliance.ready["api"]), verify=False, timeout=60)  # noqa: S501  of the test

    def begin(self) -> str:
        keys = keys_of(self.token)
        reading, verifying = (base64.urlsafe_b64encode(key).decode().rstrip("=") for key in keys)
        body = {"id": self.token.split("_")[1], "reading": reading, "verifying": verifying}
        return str(self.rest.post("/v1/sso/begin", json=body).raise_for_status().json()["url"])

    def return_from(self, url: str, person: str) -> dict[str, str]:
        parts = urlsplit(url)
        assert parts.hostname == NAME
        answer = httpx.post(
            url.replace(NAME, "127.0.0.1"),
            data={"sub": person},
            headers={"Host": parts.netloc},
            verify=False,  # noqa: S501  of the test
            timeout=60,
        )
        place = answer.headers["location"]
        assert place.startswith("https://127.0.0.1:8443/console?")
        given = dict(parse_qsl(urlsplit(place).query))
        return {name: given[name] for name in ("state", "code", "iss") if name in given}

    def sign_on(self, person: str) -> httpx.Response:
        return self.rest.post("/v1/sso/complete", json=self.return_from(self.begin(), person))

    def who(self) -> Any:
        return self.rest.get("/v1/whoami", headers={"Authorization": f"Bearer {reading_key(self.token)}"})


@pytest.fixture
def opened(running: Appliance) -> Iterator[Callable[[], Browser]]:
    with contextlib.ExitStack() as stack:

        def open_browser() -> Browser:
            browser = Browser(running)
            stack.callback(browser.rest.close)
            return browser

        yield open_browser


def test_a_person_signs_in_and_a_restart_ends_the_session(
    running: Appliance, opened: Callable[[], Browser]
) -> None:
    browser = opened()
    signed = browser.sign_on("alice").raise_for_status().json()
    assert (signed["name"], signed["role"], signed["groups"]) == ("sso:alice", "operator", ["floor"])
    assert browser.who().json()["name"] == "sso:alice"
    assert browser.rest.get("/v1/sso/sessions").status_code == 401
    bare = browser.rest.get("/v1/whoami", headers={"Authorization": f"Bearer {browser.token}"})
    assert bare.status_code == 401
    running.stop()
    running.start()
    again = opened()
    again.token = browser.token
    assert again.who().status_code == 401


class TestProxy:
    @pytest.fixture
    def way(self, proxy: Proxy) -> str:
        return f"proxy: http://127.0.0.1:{proxy.server_address[1]}"

    def test_tls_names_the_provider_through_the_proxy(
        self,
        opened: Callable[[], Browser],
        proxy: Proxy,
        provider: int,
        tmp_path: Path,
        certificates: Certificates,
    ) -> None:
        (tmp_path / "ca.pem").write_bytes(make_certificates(tmp_path / "other").ca.read_bytes())
        keys = [base64.urlsafe_b64encode(bytes(32)).decode().rstrip("=")] * 2
        body = {"id": "0" * 12, "reading": keys[0], "verifying": keys[1]}
        refused = opened().rest.post("/v1/sso/begin", json=body)
        assert refused.status_code == 503
        assert "certificate verify failed" in refused.json()["detail"]
        (tmp_path / "ca.pem").write_bytes(certificates.ca.read_bytes())
        asked_again = time.monotonic() + 5  # a failure of the provider is the answer for five seconds
        eventually(lambda: time.monotonic() > asked_again, "five seconds")
        assert opened().sign_on("alice").raise_for_status().json()["role"] == "operator"
        assert {*proxy.connected} == {f"CONNECT {NAME}:{provider}"}


def test_a_person_without_a_role_and_a_used_code_get_no_session(opened: Callable[[], Browser]) -> None:
    other = opened()
    refused = other.sign_on("mallory")
    assert refused.status_code == 422
    assert "mallory has no role here" in refused.json()["detail"]
    browser, thief = opened(), opened()
    back = browser.return_from(browser.begin(), "alice")
    own = thief.return_from(thief.begin(), "mallory")
    stolen = thief.rest.post("/v1/sso/complete", json={**own, "code": back["code"]})
    assert stolen.status_code in (422, 503)  # the provider refuses the verifier, or the code's client
    assert thief.who().status_code == 401
