"""Tests of `appliance.cli.rest.session`: where a token goes, where not, and what a user is told."""

import datetime
import ipaddress
import json
import ssl
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from typer.testing import CliRunner

from appliance.cli.main import app
from appliance.signing.request_signing import is_signed, keys_of, parse_proof, reading_key, statement

TOKEN = "rosrv_5c0f3d2b9a11_" + "x" * 43
SHOWN = f"Bearer {reading_key(TOKEN)}"


@dataclass
class Server:
    """A server that gives one answer, and remembers what it was sent."""

    status: int = 200
    body: bytes = b"{}"
    headers: dict[str, str] = field(default_factory=dict)
    seen: list[tuple[str, str, str | None]] = field(default_factory=list)
    bodies: list[bytes] = field(default_factory=list)
    proofs: list[str | None] = field(default_factory=list)
    context: ssl.SSLContext | None = None
    url: str = ""

    def problem(self, status: int, detail: str, kind: str = "refused", **headers: str) -> None:
        """Answer with a problem from now on."""
        self.status, self.headers = status, {name.replace("_", "-"): text for name, text in headers.items()}
        self.body = json.dumps({"type": f"urn:rosrv:problem:{kind}", "detail": detail}).encode()

    def __enter__(self) -> "Server":
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/v1/challenge":
                    answer = b'{"challenge": "a.challenge", "seconds": 60}'
                    self.send_response(200)
                    self.send_header("Content-Length", str(len(answer)))
                    self.end_headers()
                    self.wfile.write(answer)
                    return
                server.bodies.append(self.rfile.read(int(self.headers.get("Content-Length", "0"))))
                server.proofs.append(self.headers.get("ROSRV-Proof"))
                server.seen.append((self.command, self.path, self.headers.get("Authorization")))
                self.send_response(server.status)
                for name, text in server.headers.items():
                    self.send_header(name, text)
                self.send_header("Content-Length", str(len(server.body)))
                self.end_headers()
                self.wfile.write(server.body)

            do_POST = do_PATCH = do_DELETE = do_GET  # noqa: N815  the same

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  as http.server names it
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        scheme = "http"
        if self.context is not None:
            self._server.socket = self.context.wrap_socket(self._server.socket, server_side=True)
            scheme = "https"
        self.url = f"{scheme}://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def server() -> Iterator[Server]:
    """A server in clear text."""
    with Server() as server:
        yield server


def run(*arguments: str, token: str | None = TOKEN, **env: str) -> tuple[int, str]:
    """Exit status and everything that was said."""
    given: dict[str, str | None] = {
        "ROSRV_TOKEN": token,
        "ROSRV_STATE": None,
        "ROSRV_API_URL": None,
        "ROSRV_API_CA": None,
    }
    done = CliRunner().invoke(app, arguments, env=given | env)
    assert not isinstance(done.exception, Exception) or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("127.0.0.1:8443", "is no URL: write https://HOST:PORT"), ("ftp://a", "is no URL"), ("https://", "is no URL"),
        ("https://a:b", "is no URL"), ("https://a/v1", "scheme, host and port only"),
        ("https://me:secret@a", "scheme, host and port only"), ("https://a?x=1", "scheme, host and port only"),
        ("http://10.0.0.2:8443", "would send the token in clear text: use https"),
        ("http://robot:8443", "would send the token in clear text: use https"),
    ],
)  # fmt: skip
def test_a_place_that_is_none_is_told(url: str, said: str) -> None:
    """Exit status 2, before anything is sent."""
    status, output = run("status", "--api", url)
    assert status == 2
    assert said in output


@pytest.mark.parametrize("token", [None, "", "  ", "two words", "nö"])
def test_without_a_token_nothing_is_sent(server: Server, token: str | None) -> None:
    """Exit status 2, and how to make one; the server hears nothing."""
    status, output = run("status", "--api", server.url, token=token)
    assert status == 2
    assert "ROSRV_TOKEN" in output
    assert "rosrv token add" in output
    assert server.seen == []


def test_two_places_are_one_too_many(tmp_path: Path, server: Server) -> None:
    """--state and --api on one command line are refused; so is --api-ca without --api, or for clear text."""
    assert "give one" in run("status", "--api", server.url, "--state", str(tmp_path))[1]
    assert "--api-ca is for --api" in run("status", "--api-ca", str(tmp_path))[1]
    assert "is clear text" in run("status", "--api", server.url, "--api-ca", str(tmp_path))[1]
    assert server.seen == []


def test_what_is_typed_goes_before_the_environment(tmp_path: Path, server: Server) -> None:
    """--state beats ROSRV_API_URL, ROSRV_API_URL beats ROSRV_STATE."""
    server.problem(403, "reached")
    assert "no appliance runs" in run("status", "--state", str(tmp_path), ROSRV_API_URL=server.url)[1]
    assert "reached" in run("status", ROSRV_API_URL=server.url, ROSRV_STATE=str(tmp_path))[1]
    assert "no appliance runs" in run("status", ROSRV_STATE=str(tmp_path))[1]


@pytest.mark.parametrize(
    ("status", "kind", "headers", "exit_status", "said"),
    [
        (401, "not-recognised", {}, 2, "the token in ROSRV_TOKEN is not taken: no good; make one"),
        (403, "not-for-this-role", {}, 2, "no good"),
        (412, "changed-meanwhile", {}, 1, "rosrv: no good"),
        (422, "refused", {}, 1, "a finding rosrv: no good"),
        (404, "unknown", {}, 1, "rosrv: no good"),
        (404, "unknown-path", {}, 2, "version does not know that over REST"),
        (429, "too-many-requests", {"Retry_After": "7"}, 2, "no good; try again in 7 s"),
        (503, "not-available", {"Retry_After": "1"}, 2, "no good; try again in 1 s"),
        (503, "not-available", {}, 1, "rosrv: no good"),
    ],
)  # fmt: skip
def test_each_refusal_is_told(  # noqa: PLR0917  one column each
    server: Server, status: int, kind: str, headers: dict[str, str], exit_status: int, said: str
) -> None:
    """Exit status 1 for a refusal as over the socket, 2 where the appliance cannot be asked; what to do."""
    server.problem(status, "no good\na finding" if status == 422 else "no good", kind, **headers)
    found = run("monitor", "enable", "x", "--api", server.url)
    assert found[0] == exit_status
    assert said in found[1]
    assert server.seen == [("PATCH", "/v1/monitors", SHOWN)]


@pytest.mark.parametrize(
    "verb", [("audit", "export"), ("audit", "search"), ("audit", "tail"), ("policy", "learn")]
)
@pytest.mark.parametrize(("status", "kind"), [(422, "bad-input"), (503, "log-unreadable"), (500, "defect")])
def test_a_log_that_cannot_be_read_is_told(
    server: Server, verb: tuple[str, ...], status: int, kind: str
) -> None:
    """Exit status 2, as where the log's file cannot be read, and what REST says of it."""
    server.problem(status, "no good", kind)
    found = run(*verb, "--api", server.url)
    assert found[0] == 2
    assert "no good" in found[1]


@pytest.mark.parametrize(
    ("status", "body"),
    [(200, b"<html>"), (200, b"[]"), (200, b"[" * 100_000), (404, b"nginx"), (500, b""), (302, b"")],
)
def test_what_is_no_appliance_is_told(server: Server, status: int, body: bytes) -> None:
    """Some other server: exit status 2, one line; a redirect is not followed, the token goes nowhere else."""
    server.status, server.body, server.headers = status, body, {"Location": f"{server.url}/elsewhere"}
    found = run("status", "--api", server.url)
    assert found[0] == 2
    assert "is not the REST of an appliance" in found[1]
    assert [path for _method, path, _token in server.seen] == ["/v1/status"]


@pytest.mark.parametrize(
    "verb",
    [
        ("search",), ("show", "18e9aa02efc40abb0e51"), ("export",), ("tail",), ("verify",), ("checkpoints",),
    ],
    ids=" ".join,
)  # fmt: skip
@pytest.mark.parametrize("body", [b'{"a":1}', b'{"records":[1],"cursor":null,"record":1,"checkpoints":[{}]}'])
def test_answers_that_are_not_as_documented_are_told(
    server: Server, verb: tuple[str, ...], body: bytes
) -> None:
    """JSON of some other server where the audit log is asked for: exit status 2, and no defect of ours."""
    server.body = body
    found = run("audit", *verb, "--api", server.url)
    assert found[0] == 2
    assert "is not the REST of an appliance" in found[1]


def test_a_proxy_and_netrc_are_not_used(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The token goes to the place that was named, whatever the environment says of proxies and passwords."""
    (tmp_path / ".netrc").write_text("machine 127.0.0.1 login a password b\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("http_proxy", "HTTP_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    server.problem(403, "reached")
    assert "reached" in run("status", "--api", server.url)[1]
    assert server.seen[0][2] == SHOWN


def test_nobody_there_is_told() -> None:
    """A port where nobody listens: exit status 2, and what to look at."""
    with Server() as server:
        url = server.url
    status, output = run("status", "--api", url)
    assert status == 2
    assert "cannot be reached" in output
    assert "api_networks" in output


def test_only_a_certificate_that_is_trusted_gets_the_token(tmp_path: Path) -> None:
    """Unknown, another's, for another name, expired, no certificate at all: nothing is sent, and each is told apart."""
    right, other, elsewhere, old = (
        tmp_path / name for name in ("right.pem", "other.pem", "elsewhere.pem", "old.pem")
    )
    contexts = {
        right: certificate(right), other: certificate(other), elsewhere: certificate(elsewhere, "10.9.9.9"),
        old: certificate(old, days=-2),
    }  # fmt: skip
    no_certificate = tmp_path / "text.pem"
    no_certificate.write_text("nothing")
    for served, trusted, said in (
        (right, None, "is not trusted: copy STATE/api/certificate.pem"), (right, other, "is not trusted"),
        (elsewhere, elsewhere, "is not for this name or address"), (old, old, "has expired"),
        (right, no_certificate, "has no certificate in PEM"), (right, tmp_path / "nowhere", "No such file"),
    ):  # fmt: skip
        with Server(context=contexts[served]) as server:
            given = [] if trusted is None else ["--api-ca", str(trusted)]
            status, output = run("status", "--api", server.url, *given)
            assert status == 2
            assert said in output, output
            assert server.seen == []
    with Server(context=contexts[right]) as server:
        server.problem(403, "reached")
        assert "reached" in run("status", "--api", server.url, "--api-ca", str(right))[1]
        assert "reached" in run("status", "--api", server.url, ROSRV_API_CA=str(right))[1]
    with Server() as server:
        assert "is it http" in run("status", "--api", server.url.replace("http:", "https:"))[1]


def certificate(path: Path, address: str = "127.0.0.1", days: int = 2) -> ssl.SSLContext:
    """A self-signed certificate for an address; the context that serves it."""
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "rosrv")])
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=10))
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))]), critical=False
        )
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    path.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    pair = path.with_suffix(".key")
    pair.write_bytes(
        path.read_bytes()
        + key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(pair)
    return context


def test_an_order_is_signed_and_the_token_is_not_sent(server: Server) -> None:
    """What a server is sent of a change proves this change and nothing else; a look needs no proof."""
    server.problem(403, "no good")
    run("monitor", "disable", "a", "b", "--api", server.url)
    run("token", "revoke", "two words", "--api", server.url)
    run("status", "--api", server.url)
    stated = [("PATCH", "/v1/monitors", "*"), ("DELETE", "/v1/tokens/two%20words", "")]
    for (method, target, match), body, proof in zip(stated, server.bodies, server.proofs, strict=False):
        assert proof is not None
        challenge, signature = parse_proof(proof)
        text = statement(
            challenge,
            method=method,
            target=target,
            if_match=match,
            content_type="application/json" if body else "",
            body=body,
        )
        assert challenge == "a.challenge"
        assert is_signed(keys_of(TOKEN).verifying, text, signature)
    assert server.proofs[2] is None
    assert all(shown == SHOWN for _method, _path, shown in server.seen)
