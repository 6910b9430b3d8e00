import re
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

Lie = Callable[["Visitor"], None]


class Visitor:
    """A client's connection. The methods raise `OSError` after the client has closed it."""

    def __init__(self, stream: socket.socket, ending: threading.Event) -> None:
        self.stream = stream
        self.ending = ending

    def request(self) -> bytes:
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            received = self.stream.recv(1)
            if not received:
                raise ConnectionResetError
            head += received
        return head

    def body(self, head: bytes) -> bytes:
        match = re.search(rb"Content-Length: (\d+)", head)
        left, parts = int(match[1]) if match else 0, []
        while left and (part := self.stream.recv(left)):
            left -= len(part)
            parts.append(part)
        return b"".join(parts)

    def give(self, body: bytes, status: str = "200 OK", *headers: str) -> None:
        lines = [f"HTTP/1.1 {status}", f"Content-Length: {len(body)}", *headers]
        self.stream.sendall("\r\n".join(lines).encode() + b"\r\n\r\n" + body)

    def repeat(self, data: bytes, pause: float) -> None:
        while not self.ending.wait(pause):
            self.stream.sendall(data)

    def wait(self) -> None:
        while self.stream.recv(65_536):
            pass


@contextmanager
def lying_collector(
    context: ssl.SSLContext, answer: Lie, before_tls: Lie = lambda _visitor: None
) -> Iterator[str]:
    listener = socket.create_server(("127.0.0.1", 0))
    ending = threading.Event()

    def serve(accepted: socket.socket) -> None:
        with accepted, suppress(OSError):
            before_tls(Visitor(accepted, ending))
            with context.wrap_socket(accepted, server_side=True) as stream:
                answer(Visitor(stream, ending))

    def accept() -> None:
        with suppress(OSError):
            while True:
                accepted, _address = listener.accept()
                threading.Thread(target=serve, args=(accepted,), daemon=True).start()

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    try:
        yield f"https://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        ending.set()
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join()
