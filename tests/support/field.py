"""A field where a robot and its operator talk, a rogue host attacks, and a test reads the audit log."""

import contextlib
import http.client
import re
import socket
import threading
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession, numbers, without_gap
from tests.support.processes import LIMIT, Event, Process, ThisMachine


class Field:
    """The hosts `robot` 10.77.0.10 (talker `/voice`), `ocu` 10.77.0.20 (listener `/ear`), `attacker` 10.77.0.66, and
    `unknown_host` 10.77.0.99, which no rule names. The appliance is 10.77.0.2.
    """

    api = "http://10.77.0.66:40404/"  # nothing listens there unless a test does

    def __init__(self, lab: Lab, home: Path, policy: str, settings: str = "") -> None:
        self.middle = lab.host("appliance", "10.77.0.2/24")
        self.robot = lab.host("robot", "10.77.0.10/24")
        self.ocu = lab.host("ocu", "10.77.0.20/24")
        self.attacker = lab.host("attacker", "10.77.0.66/24")
        self.unknown_host = lab.host("unknown", "10.77.0.99/24")
        self.policy = policy
        self.home = home
        self.appliance = Appliance(self.middle, policy=policy, settings=settings)
        self.answers: list[tuple[str, Any]] = []
        self._looked_at = (
            0  # the first event of the listener that `unharmed` has not yet compared with its predecessor
        )
        self._closing = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.appliance)
            # The last 1,000 lines include records from before the audit log could be queried.
            tail = ("audit", "tail", "--lines", "1000", "--json")
            command = [ROSRV, *tail, "--state", str(self.appliance.state)]
            self.trail = stack.enter_context(
                Process(ThisMachine(), command, env={"PYTHONUNBUFFERED": "1"}, label="audit tail")
            )
            self.ros = stack.enter_context(RosSession(self.appliance.master_uri, self.home, self.robot))
            self.talker = self.ros.talker("rospy", "/chatter", "--rate", "50", name="voice")
            self.listener = self.ros.on(self.ocu).listener("roscpp", "/chatter", name="ear")
            self.listener.wait_for(event="received")
            self._closing = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._closing.close()

    @property
    def master(self) -> str:
        return self.appliance.master_uri

    # --- actions of the rogue ---

    def rogue(self, method: str, *parameters: Any, uri: str | None = None) -> Any:
        return self.call(self.attacker, method, *parameters, uri=uri)

    def call(self, host: Host, method: str, *parameters: Any, uri: str | None = None) -> Any:
        def call() -> Any:
            with xmlrpc.client.ServerProxy(uri or self.master, allow_none=True) as server:
                try:
                    return server.__getattr__(method)(*parameters)
                except (xmlrpc.client.Error, http.client.HTTPException) as error:
                    return error

        answer = host.run(call)
        if host is not self.robot:
            self.answers.append((method, answer))
        return answer

    def raw(self, data: bytes, host: Host | None = None, port: int = 11311) -> bytes:
        with self.connect(host, port) as sock:
            sock.sendall(data)
            received = b""
            with contextlib.suppress(ConnectionResetError):
                while piece := sock.recv(65536):
                    received += piece
                    if whole(received):
                        break
        self.answers.append(("raw", received))
        return received

    def connect(self, host: Host | None = None, port: int = 11311) -> socket.socket:
        return (host or self.attacker).run(lambda: socket.create_connection(("10.77.0.2", port), LIMIT))

    # --- promises that must hold afterwards ---

    def recorded(self, reason: str = "", **fields: Any) -> Event:
        return self.trail.wait_for(lambda event: reason in (event.get("reason") or ""), **fields)

    def unharmed(self, messages: int = 3) -> None:
        now = self.listener.mark()
        self.listener.wait_for_count(messages, since=now, event="received")
        heard = [
            event for event in self.listener.events[self._looked_at :] if event.get("event") == "received"
        ]
        assert without_gap(numbers(heard)), "messages are missing or repeated"
        assert {event["publisher"] for event in heard} == {"/voice"}
        self._looked_at = now  # the next check begins here, without a gap
        assert self.talker.running
        assert self.listener.running

    def memory(self, role: str = "control") -> int:
        status = Path(f"/proc/{self.appliance.pids(role)[0]}/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) << 10  # type: ignore[index]  # the kernel always writes it

    def story(self) -> str:
        return "\n".join([self.appliance.story(), self.trail.story(), self.ros.story()])


class Impostor:
    def __init__(
        self, host: Host, behave: Callable[[socket.socket, bytes], object], address: str | None = None
    ) -> None:
        self.requests: list[bytes] = []
        self.peers: list[str] = []
        self.called = threading.Event()
        self._behave = behave
        self._socket = host.run(lambda: socket.create_server((address or host.address, 0)))
        self.port: int = self._socket.getsockname()[1]
        self.uri = f"http://{host.address}:{self.port}/"
        self._open: set[socket.socket] = set()
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection, peer = self._socket.accept()
            except OSError:
                return
            self.peers.append(peer[0])
            self._open.add(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            request = b""
            while not whole(request):
                piece = connection.recv(65536)
                if not piece:
                    break
                request += piece
            self.requests.append(request)
            self.called.set()
            self._behave(connection, request)
        self._open.discard(connection)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        for connection in list(self._open):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._thread.join(LIMIT)


def whole(message: bytes) -> bool:
    head, end, body = message.partition(b"\r\n\r\n")
    match = re.search(rb"(?i)content-length: *(\d+)", head)
    return bool(end) and match is not None and len(body) >= int(match[1])


def answering(value: Any) -> Callable[[socket.socket, bytes], None]:
    def behave(connection: socket.socket, _request: bytes) -> None:
        connection.sendall(response(value))

    return behave


def response(value: Any) -> bytes:
    body = xmlrpc.client.dumps((value,), methodresponse=True).encode()
    return b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n" % len(body) + body
