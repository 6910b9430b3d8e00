"""Test a running appliance with two minimal ROS nodes: a publisher and a subscriber of one message.

They always unregister at the end.
"""

import contextlib
import http.client
import socket
import threading
import xmlrpc.client
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit
from xml.parsers import expat
from xmlrpc.server import SimpleXMLRPCServer

from roswire.tcpros import FrameParser, HeaderParser, encode_frame, encode_header

TOPIC = "/rosrv_selftest"
_PUBLISHER, _SUBSCRIBER = "/rosrv_selftest_publisher", "/rosrv_selftest_subscriber"
_TYPE = "std_msgs/String"
_MD5SUM = "992ce8a1687cec8c8bd883ec73ca41d1"
_SECONDS = 10.0


class ProbeError(Exception):
    """RVMaster or a proxy endpoint denied a call; the text is the reason."""


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: object) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(str(host), timeout=_SECONDS)


def call(uri: str, method: str, *arguments: Any) -> Any:
    try:
        with xmlrpc.client.ServerProxy(uri, _Transport()) as server:
            answer = getattr(server, method)(*arguments)  # how the library calls a method by its name
    except xmlrpc.client.Fault as fault:
        raise ProbeError(fault.faultString) from fault
    except (xmlrpc.client.Error, http.client.HTTPException, expat.ExpatError, ValueError) as error:
        raise OSError(f"{uri}: {error}") from error
    if not isinstance(answer, list) or len(answer) != 3:
        raise OSError(f"{uri}: {method} returned {str(answer)[:100]}, which is not a ROS answer")
    if answer[0] != 1:
        raise ProbeError(str(answer[1]))
    return answer[2]


def own_address(master: str) -> str:
    place = urlsplit(master)
    with socket.create_connection((str(place.hostname), place.port or 80), _SECONDS) as sock:
        return str(sock.getsockname()[0])


def message_through_the_relay(master: str) -> bytes:
    host = own_address(master)
    with _node(host) as publisher, _node(host) as subscriber:
        try:
            call(master, "registerPublisher", _PUBLISHER, TOPIC, _TYPE, publisher.uri)
            places = call(master, "registerSubscriber", _SUBSCRIBER, TOPIC, _TYPE, subscriber.uri)
            if not places:
                raise ProbeError(f"RVMaster lists no publisher of {TOPIC} to the subscriber")
            return _receive(places[0])
        finally:
            with contextlib.suppress(OSError, ProbeError):
                call(master, "unregisterSubscriber", _SUBSCRIBER, TOPIC, subscriber.uri)
            with contextlib.suppress(OSError, ProbeError):
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
                raise ProbeError("the connection was closed before a message came")
            if fields is None:
                fields = header.feed(data)
                if fields is None:
                    continue
                if "error" in fields:
                    raise ProbeError(fields["error"])
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
    def __init__(self, host: str) -> None:
        self._messages = socket.create_server((host, 0), family=_family(host))
        port = self._messages.getsockname()[1]

        class Server(SimpleXMLRPCServer):
            address_family = _family(host)

            def _dispatch(self, method: str, _parameters: object) -> list[object]:
                return [1, "", ["TCPROS", host, port] if method == "requestTopic" else 0]

        self._api = Server((host, 0), logRequests=False)
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
                connection.recv(1)  # wait until the appliance has the message and disconnects

    def close(self) -> None:
        self._api.shutdown()
        self._api.server_close()
        self._messages.close()


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


@contextlib.contextmanager
def _node(host: str) -> Iterator[_Node]:
    node = _Node(host)
    try:
        yield node
    finally:
        node.close()
