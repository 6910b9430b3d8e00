import contextlib
import re
import socket
import ssl
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

LIMIT = 60.0

# RFC 5424, 6: the header, structured data, the text.
_HEADER = re.compile(
    rb"<(0|[1-9]\d{0,2})>1 (-|\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d{1,6})?(?:Z|[+-]\d\d:\d\d))"
    rb" ([!-~]{1,255}) ([!-~]{1,48}) ([!-~]{1,128}) ([!-~]{1,32}) "
)
_NAME = rb"[!#-<>-\\^-~]{1,32}"
_PARAMETER = re.compile(rb" (" + _NAME + rb')="((?:[^"\\\]]|\\["\\\]])*)"')
_ELEMENT = re.compile(rb"\[(" + _NAME + rb")((?: " + _NAME + rb'="(?:[^"\\\]]|\\["\\\]])*")*)\]')


@dataclass(frozen=True)
class Message:
    facility: int
    severity: int
    time: str
    host: str
    program: str
    event: str
    elements: dict[str, dict[str, str]]
    text: str
    size: int

    @property
    def fields(self) -> dict[str, str]:
        return next(iter(self.elements.values()))


def parse(data: bytes) -> Message:
    header = _HEADER.match(data)
    assert header is not None, data
    priority = int(header[1])
    assert priority <= 191, data
    rest, elements = data[header.end() :], {}
    if rest.startswith(b"-"):
        rest = rest[1:]
    else:
        while (element := _ELEMENT.match(rest)) is not None:
            parameters = {
                name.decode(): re.sub(rb"\\(.)", rb"\1", value).decode()
                for name, value in _PARAMETER.findall(element[2])
            }
            elements[element[1].decode()] = parameters
            rest = rest[element.end() :]
        assert elements, data
    assert not rest or rest.startswith(b" "), data
    return Message(
        priority // 8,
        priority % 8,
        header[2].decode(),
        header[3].decode(),
        header[4].decode(),
        header[6].decode(),
        elements,
        rest[1:].decode(),
        len(data),
    )


class _Collector:
    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.problems: list[str] = []
        self._changed = threading.Condition()

    def wait_for(self, condition: Callable[[list[Message]], object], timeout: float = LIMIT) -> list[Message]:
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.messages), timeout), (
                len(self.messages),
                self.problems,
                self.messages[-3:],
            )
            return list(self.messages)

    def sequences(self) -> list[int]:
        with self._changed:
            return [int(one.fields["sequence"]) for one in self.messages if "rosrv@32473" in one.elements]

    def _take(self, data: bytes) -> None:
        with self._changed:
            self.messages.append(parse(data))
            self._changed.notify_all()

    def _complain(self, error: Exception) -> None:
        with self._changed:
            self.problems.append(f"{type(error).__name__}: {error}")
            self._changed.notify_all()


class DatagramCollector(_Collector):
    def __init__(self, host: str = "127.0.0.1") -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        self._socket.settimeout(0.2)
        self.port = self._socket.getsockname()[1]
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._ending.is_set():
            with contextlib.suppress(TimeoutError):
                self._take(self._socket.recv(65_536))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_exc: object) -> None:
        self._ending.set()
        self._thread.join()
        self._socket.close()


class StreamCollector(_Collector):
    def __init__(self, host: str = "127.0.0.1", context: ssl.SSLContext | None = None, port: int = 0) -> None:
        super().__init__()
        self._place = (host, port)
        self._context = context
        self._listener: socket.socket | None = None
        self._connections: list[socket.socket] = []
        self.connected = 0
        self.open()

    @property
    def port(self) -> int:
        return self._place[1]

    def open(self) -> None:
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.bind(self._place)
        self._listener.listen(8)
        self._place = (self._place[0], self._listener.getsockname()[1])
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def close(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        connections, self._connections = self._connections, []
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _peer = listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            if self._context is not None:
                connection = self._context.wrap_socket(connection, server_side=True)
            self._connections.append(connection)
            self.connected += 1
            with connection.makefile("rb") as stream:
                while (message := _counted(stream.read)) is not None:
                    self._take(message)
        except (OSError, AssertionError, ValueError) as error:
            self._complain(error)
        finally:
            connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.close()


def _counted(read: Callable[[int], bytes]) -> bytes | None:
    digits = b""
    while (one := read(1)) != b" ":
        if not one:
            return None
        digits += one
        assert digits.isdigit(), digits
        assert len(digits) < 8, digits
    message = read(int(digits))
    return message if len(message) == int(digits) else None
