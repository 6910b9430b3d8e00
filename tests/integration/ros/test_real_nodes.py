import http.client
import http.server
import os
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from roswire.definitions import Definitions
from roswire.message_layout import StringPart
from roswire.standard import standard_definitions
from roswire.tcpros import FrameParser, HeaderParser, ServiceReplyParser, encode_frame, encode_header
from roswire.uris import parse_node_uri, parse_service_uri
from roswire.xmlrpc import MethodCall, build_call, build_response, parse_call, parse_response
from tests.support.nodes import Client, RosSession
from tests.support.processes import LIMIT
from tests.support.site import Masters

CLIENTS: list[Client] = ["rospy", "roscpp"]


@pytest.fixture(scope="module")
def ros(masters: Masters, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSession]:
    home = tmp_path_factory.mktemp("ros")
    with masters.lend("plain", "loopback") as site, RosSession(site.master_uri, home) as session:
        yield session


@pytest.fixture(scope="module")
def standard() -> Definitions:
    return standard_definitions()


def call(uri: str, method: str, *params: Any) -> Any:
    target = parse_node_uri(uri)
    connection = http.client.HTTPConnection(target.host, target.port, timeout=LIMIT)
    try:
        connection.request("POST", target.path, build_call(method, params), {"Content-Type": "text/xml"})
        answer = parse_response(connection.getresponse().read())
    finally:
        connection.close()
    assert isinstance(answer, list)
    assert answer[0] == 1, answer
    return answer[2]


def receive_header(connection: socket.socket) -> tuple[dict[str, str], bytes]:
    parser = HeaderParser()
    while (fields := parser.feed(received(connection))) is None:
        pass
    return fields, parser.rest


def received(connection: socket.socket) -> bytes:
    data = connection.recv(65536)
    assert data, "the peer closed the connection"
    return data


@pytest.mark.parametrize("client", CLIENTS)
def test_a_publisher_is_understood(ros: RosSession, standard: Definitions, client: Client) -> None:
    topic = f"/{client}_chatter"
    name = f"{client}_talker"
    ros.talker(client, topic, name=name)
    api = call(ros.master_uri, "lookupNode", "/test", f"/{name}")
    protocol, host, port = call(api, "requestTopic", "/test", topic, [["TCPROS"]])
    assert protocol == "TCPROS"
    with socket.create_connection((host, port), LIMIT) as connection:
        md5sum = standard.md5sum("std_msgs/String")
        wanted = {"callerid": "/test", "topic": topic, "type": "std_msgs/String", "md5sum": md5sum}
        connection.sendall(encode_header(wanted))
        fields, rest = receive_header(connection)
        assert fields["callerid"] == f"/{name}"
        assert fields["md5sum"] == md5sum
        definitions = Definitions.from_full_text(fields["type"], fields["message_definition"])
        assert definitions.md5sum(fields["type"]) == md5sum
        frames = FrameParser()
        messages = frames.feed(rest)
        while not messages:
            messages = frames.feed(received(connection))
    assert definitions.layout("std_msgs/String").parts == (StringPart("data"),)
    assert messages[0][4:].startswith(b"hello")


@pytest.mark.parametrize("client", CLIENTS)
def test_a_subscriber_is_understood(ros: RosSession, standard: Definitions, client: Client) -> None:
    topic = f"/{client}_heard"
    with (
        socket.create_server((ros.host.address, 0)) as data_port,
        NodeApi(ros.host.address, data_port) as api,
    ):
        data_port.settimeout(LIMIT)
        call(ros.master_uri, "registerPublisher", "/publisher", topic, "std_msgs/String", api.uri)
        listener = ros.listener(client, topic, name=f"{client}_listener")
        connection, _ = data_port.accept()
        with connection:
            fields, rest = receive_header(connection)
            assert rest == b""
            assert fields["callerid"] == f"/{client}_listener"
            assert fields["topic"] == topic
            assert fields["md5sum"] == standard.md5sum(fields["type"])
            text = standard.full_text("std_msgs/String")
            own = {"callerid": "/publisher", "latching": "0", "md5sum": fields["md5sum"]}
            own |= {"message_definition": text, "topic": topic, "type": fields["type"]}
            connection.sendall(encode_header(own) + encode_frame(encode_frame(b"from us")))
            heard = listener.wait_for(event="received")
    assert heard["data"] == "from us"
    assert heard["publisher"] == "/publisher"
    assert MethodCall("requestTopic", (f"/{client}_listener", topic, [["TCPROS"]])) in api.calls


@pytest.mark.parametrize("client", CLIENTS)
def test_a_service_is_understood(ros: RosSession, standard: Definitions, client: Client) -> None:
    service = f"/{client}_negate"
    ros.service_server(client, service, name=f"{client}_server")
    target = parse_service_uri(call(ros.master_uri, "lookupService", "/test", service))
    with socket.create_connection((target.host, target.port), LIMIT) as connection:
        wanted = {"callerid": "/test", "service": service, "persistent": "1"}
        connection.sendall(encode_header(wanted | {"md5sum": standard.service_md5sum("std_srvs/SetBool")}))
        fields, rest = receive_header(connection)
        assert fields["callerid"] == f"/{client}_server"
        replies = ServiceReplyParser()
        assert replies.feed(rest) == []
        for data in (b"\x01", b"\x00"):
            connection.sendall(encode_frame(data))
            answered = replies.feed(received(connection))
            while not answered:
                answered = replies.feed(received(connection))
            (reply,) = answered
            assert reply.ok
            assert len(reply.body) == 5 + int.from_bytes(
                reply.body[1:5], "little"
            )  # bool success, string message


class NodeApi:
    def __init__(self, address: str, data_port: socket.socket) -> None:
        self.calls: list[MethodCall] = []
        calls, port = self.calls, data_port.getsockname()[1]

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                made = parse_call(self.rfile.read(int(self.headers["Content-Length"])))
                calls.append(made)
                offer: Any = ["TCPROS", address, port] if made.method == "requestTopic" else os.getpid()
                body = build_response([1, "", offer])
                self.send_response(200)
                self.send_header("Content-Type", "text/xml")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_arguments: object) -> None: ...

        self._server = http.server.ThreadingHTTPServer((address, 0), Handler)
        self._server.daemon_threads = True
        self.uri = f"http://{address}:{self._server.server_port}/"

    def __enter__(self) -> "NodeApi":
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
