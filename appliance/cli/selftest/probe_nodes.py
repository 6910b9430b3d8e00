"""Two tiny ROS nodes that try a running appliance from outside: a publisher and a subscriber of one message.

They do what any node does, over its own sockets: register, answer `requestTopic`, connect, take a message. They leave
nothing behind: both unregister, whatever happened.
"""

import contextlib
import http.client
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from roswire.errors import PeerError
from roswire.tcpros import FrameParser, HeaderParser, encode_frame, encode_header
from roswire.xmlrpc import FaultReceived, build_call, build_response, parse_call, parse_response

TOPIC = "/rosrv_selftest"
_PUBLISHER, _SUBSCRIBER = "/rosrv_selftest_publisher", "/rosrv_selftest_subscriber"
_TYPE = "std_msgs/String"
_MD5SUM = "992ce8a1687cec8c8bd883ec73ca41d1"
_SECONDS = 10.0


class RefusedError(Exception):
    """RVMaster, or what stands for a node, refused a call; the text is its reason."""


def call(uri: str, method: str, *arguments: Any) -> Any:
    """Make an XML-RPC call of ROS: the value of the answer. Raises `RefusedError`, `OSError`."""
    place = urlsplit(uri)
    connection = http.client.HTTPConnection(str(place.hostname), place.port or 80, timeout=_SECONDS)
    try:
        connection.request(
            "POST", place.path or "/", build_call(method, arguments), {"Content-Type": "text/xml"}
        )
        answer = parse_response(connection.getresponse().read())
    except FaultReceived as fault:
        raise RefusedError(str(fault)) from fault
    except (http.client.HTTPException, PeerError) as error:
        raise OSError(f"{uri}: {error}") from error
    finally:
        connection.close()
    if not isinstance(answer, list) or len(answer) != 3:
        raise OSError(f"{uri}: {method} is answered with {str(answer)[:100]}, as no ROS program does")
    if answer[0] != 1:
        raise RefusedError(str(answer[1]))
    return answer[2]


def own_address(master: str) -> str:
    """The address of this machine that the appliance sees."""
    place = urlsplit(master)
    with socket.create_connection((str(place.hostname), place.port or 80), _SECONDS) as sock:
        return str(sock.getsockname()[0])


def message_through_the_relay(master: str) -> bytes:
    """Publish one message and receive it through the appliance. Raises `RefusedError`, `OSError`."""
    host = own_address(master)
    with _node(host) as publisher, _node(host) as subscriber:
        try:
            call(master, "registerPublisher", _PUBLISHER, TOPIC, _TYPE, publisher.uri)
            places = call(master, "registerSubscriber", _SUBSCRIBER, TOPIC, _TYPE, subscriber.uri)
            if not places:
                raise RefusedError(f"no publisher of {TOPIC} is shown to the subscriber")
            return _receive(places[0])
        finally:
            with contextlib.suppress(OSError, RefusedError):
                call(master, "unregisterSubscriber", _SUBSCRIBER, TOPIC, subscriber.uri)
            with contextlib.suppress(OSError, RefusedError):
                call(master, "unregisterPublisher", _PUBLISHER, TOPIC, publisher.uri)


def _receive(uri: str) -> bytes:
    protocol = call(uri, "requestTopic", _SUBSCRIBER, TOPIC, [["TCPROS"]])
    _name, host, port = protocol
    with socket.create_connection((host, port), _SECONDS) as sock:
        sock.sendall(encode_header(_fields(_SUBSCRIBER)))
        header, frames = HeaderParser(), FrameParser()
        fields = None
        while True:
            data = sock.recv(65_536)
            if not data:
                raise RefusedError("the connection was closed before a message came")
            if fields is None:
                fields = header.feed(data)
                if fields is None:
                    continue
                if "error" in fields:
                    raise RefusedError(fields["error"])
                data = bytes(header.rest)
            found = frames.feed(data)
            if found:
                return bytes(found[0])


def _fields(node: str) -> dict[str, str]:
    return {
        "callerid": node,
        "topic": TOPIC,
        "type": _TYPE,
        "md5sum": _MD5SUM,
        "message_definition": "string data\n",
    }


class _Node:
    """A node's API, and its TCPROS port, which gives whoever connects one message."""

    def __init__(self, host: str) -> None:
        self._messages = socket.create_server((host, 0), family=_family(host))
        port = self._messages.getsockname()[1]

        class Api(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                answer = build_response(_answer(parse_call(body).method, host, port))
                self.send_response(200)
                self.send_header("Content-Type", "text/xml")
                self.send_header("Content-Length", str(len(answer)))
                self.end_headers()
                self.wfile.write(answer)

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  as http.server names it
                """Say nothing."""

        class Server(ThreadingHTTPServer):
            address_family = _family(host)
            daemon_threads = True

        self._api = Server((host, 0), Api)
        shown = f"[{host}]" if ":" in host else host
        self.uri = f"http://{shown}:{self._api.server_address[1]}/"
        for work in (self._api.serve_forever, self._give):
            threading.Thread(target=work, daemon=True).start()

    def _give(self) -> None:
        while True:
            try:
                connection, _peer = self._messages.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                connection.settimeout(_SECONDS)
                connection.recv(65_536)
                connection.sendall(
                    encode_header(_fields(_PUBLISHER)) + encode_frame(encode_frame(b"selftest"))
                )
                connection.recv(1)  # until the appliance has it and goes

    def close(self) -> None:
        """End it."""
        self._api.shutdown()
        self._api.server_close()
        self._messages.close()


def _answer(method: str, host: str, port: int) -> Any:
    if method == "requestTopic":
        return [1, "ready", ["TCPROS", host, port]]
    return [1, "", 0]


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


@contextlib.contextmanager
def _node(host: str) -> Iterator[_Node]:
    node = _Node(host)
    try:
        yield node
    finally:
        node.close()
