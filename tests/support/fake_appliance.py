"""Fake an appliance that gives a test's answers over its admin socket and over REST, and keeps the requests.

fake.answer("status", version="1.0")        # fields that are not given are empty, zero or None
fake.reject("monitor enable", "unknown", "no monitor is named x")
fake.problem(403, "refused", "for admins")  # every answer of REST
"""

import contextlib
import json
import socket
import ssl
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

import msgspec

from appliance.channel.admin import AdminAnswer, AdminRequest, Trouble, answer_to, encode
from appliance.channel.operations import AnyRequest
from appliance.signing.request_signing import is_signed, keys_of, parse_proof, reading_key, statement
from tests.support.answers import example

TOKEN = "rosrv_5c0f3d2b9a11_" + "x" * 43
_KINDS: dict[str, type[AdminRequest[Any]]] = {
    str(kind.__struct_config__.tag): kind for kind in get_args(AnyRequest)
}
Answer = Callable[[dict[str, Any]], AdminAnswer[Any]]


class FakeAppliance:
    def __init__(self, context: ssl.SSLContext | None = None) -> None:
        self.requests: list[str] = []
        """The JSON of requests at the admin socket, and the method, path and body of those over REST."""
        self.status, self.headers, self.body = 200, dict[str, str](), b"{}"
        self._answers: dict[str, Answer] = {}
        self._context = context
        self._ends = contextlib.ExitStack()
        self._url = ""

    def __enter__(self) -> "FakeAppliance":
        return self

    def __exit__(self, *exc: object) -> None:
        self._ends.close()

    # --- the admin socket ---

    def answer(self, verb: str, **fields: Any) -> None:
        body = example(answer_to(_KINDS[verb]), **fields)
        self.decide(verb, lambda _request: AdminAnswer(True, body))

    def reject(self, verb: str, trouble: Trouble, error: str, *findings: str) -> None:
        self.decide(verb, lambda _request: AdminAnswer(False, None, error, list(findings), trouble))

    def decide(self, verb: str, answer: Answer) -> None:
        assert verb in _KINDS, f"{verb!r} is not one of {sorted(_KINDS)}"
        self._answers[verb] = answer

    def serve(self, state: Path) -> Path:
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(str(state / "admin.sock"))
        listener.listen()
        thread = threading.Thread(target=self._accept, args=(listener,), daemon=True)
        thread.start()
        self._ends.callback(thread.join, 30)
        self._ends.callback(listener.close)
        self._ends.callback(listener.shutdown, socket.SHUT_RDWR)
        return state

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:  # the end of the test closes the listener
                return
            with peer, peer.makefile("rb") as lines:
                for line in lines:
                    self.requests.append(line.decode().strip())
                    request = msgspec.json.decode(line)
                    answer = self._answers.get(request["verb"], _unknown)
                    try:
                        peer.sendall(encode(answer(request)) + b"\n")
                    except ConnectionResetError:  # the appliance ends before it answers
                        break

    # --- REST ---

    def problem(
        self, status: int, kind: str, detail: str, headers: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        self.status, self.headers = status, dict(headers)
        self.body = json.dumps({"type": f"urn:rosrv:problem:{kind}", "detail": detail}).encode()

    @property
    def url(self) -> str:
        if not self._url:
            server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
            if self._context is not None:
                server.socket = self._context.wrap_socket(server.socket, server_side=True)
            threading.Thread(target=server.serve_forever, daemon=True).start()
            self._ends.callback(server.server_close)
            self._ends.callback(server.shutdown)
            scheme = "http" if self._context is None else "https"
            self._url = f"{scheme}://127.0.0.1:{server.server_address[1]}"
        return self._url

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        fake = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                challenge = self.path == "/v1/challenge"
                if not challenge:
                    body = self.rfile.read(int(self.headers.get("Content-Length", "0")))
                    proven = _proven(self.command, self.path, dict(self.headers), body)
                    fake.requests.append(f"{self.command} {self.path} {body.decode()}".strip() + proven)
                answer = b'{"challenge": "a.challenge", "seconds": 60}' if challenge else fake.body
                self.send_response(200 if challenge else fake.status)
                for name, text in ({} if challenge else fake.headers).items():
                    self.send_header(name, text)
                self.send_header("Content-Length", str(len(answer)))
                self.end_headers()
                self.wfile.write(answer)

            do_POST = do_PATCH = do_DELETE = do_PUT = do_GET  # noqa: N815  the same

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  as http.server names it
                ...

        return Handler


def _unknown(request: dict[str, Any]) -> AdminAnswer[Any]:
    return AdminAnswer(False, error=f"the test has no answer to {request['verb']!r}", trouble="failed")


def _proven(method: str, path: str, headers: dict[str, str], body: bytes) -> str:
    """Return how a request proves its token, which it must never send itself."""
    if headers.get("Authorization") != f"Bearer {reading_key(TOKEN)}":
        return f" (Authorization: {headers.get('Authorization')})"
    if (proof := headers.get("ROSRV-Proof")) is None:
        return ""
    challenge, signature = parse_proof(proof)
    stated = statement(
        challenge,
        method=method,
        target=path,
        if_match=headers.get("If-Match", ""),
        content_type=headers.get("Content-Type", ""),
        body=body,
    )
    proves = challenge == "a.challenge" and is_signed(keys_of(TOKEN).verifying, stated, signature)
    return " (signed)" if proves else " (WRONG SIGNATURE)"
