"""Open a connection to a master, and call getPid over it after an input line.

    python -m tests.support.held_connection MASTER OWN-ADDRESS

It prints one event per line: `opened`, then `answered`, or `closed` if the connection ends first.
"""

import contextlib
import json
import socket
import sys
import threading

from tests.support.waiting import eventually

PORT = 11311
BODY = b"<methodCall><methodName>getPid</methodName><params><param><value>/x</value></param></params></methodCall>"
REQUEST = b"POST / HTTP/1.1\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n%s" % (len(BODY), BODY)


def connected(master: str, own: str) -> socket.socket | None:
    try:
        return socket.create_connection((master, PORT), 1, (own, 0))
    except OSError:
        return None


def ask(connection: socket.socket) -> None:
    if sys.stdin.readline():
        with contextlib.suppress(OSError):
            connection.sendall(REQUEST)


def tell(event: str) -> None:
    print(json.dumps({"event": event}), flush=True)  # noqa: T201  the tests read it


def main(master: str, own: str) -> None:
    connection = eventually(lambda: connected(master, own), "the master accepts a connection")
    connection.settimeout(None)
    tell("opened")
    threading.Thread(target=ask, args=(connection,), daemon=True).start()
    try:
        tell("answered" if connection.recv(1) else "closed")
    except OSError:
        tell("closed")


if __name__ == "__main__":
    main(*sys.argv[1:])
