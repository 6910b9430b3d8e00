"""Run a fleet's bundles: an operator's repository, and a collector that can lie about everything that it serves."""

import datetime
import http.server
import json
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from rosrv_fleet.bundles.publication import next_timestamp, read_publication
from rosrv_fleet.bundles.repository import TIMESTAMP_KEY, BundleRepository, KeyFolder, load_online_key

from appliance.formats.terms import BundlePath, Ring, Terms
from fleet.tests.support.fleet_certificates import FleetAuthority

PASSPHRASE = "a passphrase for tests"  # noqa: S105  of keys that a test makes
SITE, GROUP, ROBOT = "site-a", "arms", "robot-1"
POLICY = (
    "[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n[Subscribers]\ndefault = *\n[Commands]\ndefault = *\n"
)
Lie = Callable[["http.server.BaseHTTPRequestHandler"], None]


def bundle_files(policy: str = POLICY, **more: str) -> dict[str, bytes]:
    files = {"policy.ini": policy, "hosts.yaml": "hosts: []\n"}
    files |= {name.replace("__", "/").replace("_dot_", "."): text for name, text in more.items()}
    return {name: text.encode() for name, text in files.items()}


def everywhere(signed: float | None = None, *rings: Ring) -> Terms:
    return Terms(int(time.time() if signed is None else signed), [*rings] or [Ring("all", [], 100)])


class SupportsClose(Protocol):
    def close(self) -> None: ...


class BundleSite:
    def __init__(self, folder: Path, now: Callable[[], datetime.datetime] | None = None) -> None:
        self.folder = folder
        self.authority = FleetAuthority(folder / "certificates")
        keys = KeyFolder(folder / "keys", lambda _path: PASSPHRASE)
        self.now = now or (lambda: datetime.datetime.now(datetime.UTC).replace(microsecond=0))
        self.repository = BundleRepository(folder / "repository", keys, now=self.now)
        self.repository.init()
        self.repository.delegate(SITE, GROUP)
        self.first_root = self.root  # what robots were given, before any rotation
        self.timestamp: bytes | None = None
        self.selection: str = ""
        self.lies: dict[str, Lie] = {}
        self.reports: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue()
        self.requests: list[str] = []
        self.wakes: list[threading.Event] = []
        self.connections: list[SupportsClose] = []

    @property
    def root(self) -> bytes:
        return (self.repository.folder / "root.json").read_bytes()

    def add(
        self, files: Mapping[str, bytes] | None = None, terms: Terms | None = None, keep: int = 2
    ) -> BundlePath:
        path = self.repository.add(SITE, GROUP, files or bundle_files(), terms or everywhere(), keep=keep)
        self.publish()
        self.selection = str(path)
        self.wake()
        return path

    def publish(self) -> None:
        publication = read_publication(self.repository.folder)
        key = load_online_key(self.repository.folder / TIMESTAMP_KEY)
        made = next_timestamp(publication, self.timestamp, key, self.now())
        self.timestamp = made or self.timestamp

    def wake(self) -> None:
        for event in self.wakes:
            event.set()

    @contextmanager
    def served(self) -> Iterator[str]:
        server = _Server(("127.0.0.1", 0), _handler(self))
        server.socket = self.authority.server_context.wrap_socket(
            server.socket, server_side=True, do_handshake_on_connect=False
        )
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            yield f"https://127.0.0.1:{server.server_address[1]}"
        finally:
            for connection in self.connections:
                connection.close()
            for event in self.wakes:
                event.set()
            server.shutdown()
            server.server_close()

    def answer(self, path: str) -> bytes | None:
        if path == "/v1/bundles/metadata/timestamp.json":
            return self.timestamp
        if path.startswith("/v1/bundles/selection/"):
            return self.selection.encode()
        for part in ("metadata", "targets"):
            beginning = f"/v1/bundles/{part}/"
            if path.startswith(beginning):
                with suppress(OSError):
                    return (self.repository.folder / part / path.removeprefix(beginning)).read_bytes()
        return None


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None: ...


def _handler(site: BundleSite) -> type[http.server.BaseHTTPRequestHandler]:
    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            site.requests.append(self.path)
            lie = site.lies.get(self.path)
            if lie is not None:
                lie(self)
            elif self.path.startswith("/v1/bundles/events/"):
                self._events()
            else:
                give(self, site.answer(self.path))

        def do_PUT(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            assert isinstance(self.connection, socket.socket)
            subject = self.connection.getpeercert()["subject"]  # type: ignore[attr-defined]  # a TLS socket
            site.reports.put((dict(pair[0] for pair in subject)["commonName"], json.loads(body)))
            give(self, b"{}")

        def _events(self) -> None:
            event = threading.Event()
            site.wakes.append(event)
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            self.close_connection = True
            with suppress(OSError):
                while event.wait(timeout=60):
                    event.clear()
                    self.wfile.write(b"event: selection\ndata: {}\n\n")
                    self.wfile.flush()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the base class names it
            ...

    return Handler


def give(handler: http.server.BaseHTTPRequestHandler, body: bytes | None) -> None:
    tag = f'"{hash(body)}"'
    if body is None:
        handler.send_response(404)
        body = b""
    elif handler.headers.get("If-None-Match") == tag:
        handler.send_response(304)
        body = b""
    else:
        handler.send_response(200)
        handler.send_header("ETag", tag)
    handler.send_header("Content-Length", str(len(body)))
    handler.end_headers()
    handler.wfile.write(body)
