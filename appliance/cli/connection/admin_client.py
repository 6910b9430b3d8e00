"""The client of the admin socket in the state directory, which only its owner and root may use."""

import fcntl
import select
import socket
import struct
import termios
from pathlib import Path

import msgspec
import typer

from appliance.channel.admin import A, AdminAnswer, AdminRequest, StatusWanted, decode
from appliance.cli.connection.starting import starting, starting_for

ADMIN_SOCKET = "admin.sock"
SECONDS = 60.0
"""The time limit of an answer, longer than control needs for enrolment through charon or compiling specifications."""
QUICK_SECONDS = 2.0
"""A short time limit, because an appliance that hangs must not keep an operator from reading the log."""
_GRACE_SECONDS = 10.0
_PATIENCE_SECONDS = 1.0
UNKNOWN = (
    "the change may have taken effect; if it has not by now, it never will. List recent changes:"
    " rosrv audit search --since 5m"
)


class RestProblemError(Exception):
    """REST denied or rejected a request; the first of `lines` is a summary."""

    def __init__(
        self, status: int, kind: str, lines: list[str], findings: list[dict[str, object]] | None = None
    ) -> None:
        super().__init__(lines[0])
        self.findings = findings
        self.status = status
        self.kind = kind
        self.lines = lines


class NotRunningError(Exception):
    """No appliance answers, or it rejects this user or token."""


class AccessDeniedError(NotRunningError):
    """The appliance rejects this user or token, so waiting does not help."""


class AdminSocket:
    """A client of the admin socket; a request is withdrawn after `seconds`; its outcome may take `grace` seconds.

    `tells`: print that a request waits for the appliance's start.
    """

    def __init__(
        self, state: Path, seconds: float = SECONDS, grace: float = _GRACE_SECONDS, *, tells: bool = False
    ) -> None:
        self.state = state
        self._seconds = seconds
        self._grace = grace
        self._tells = tells

    def robot_name(self) -> str:
        try:
            answer = AdminSocket(self.state, QUICK_SECONDS, 0.1).ask(StatusWanted())
        except NotRunningError:
            return ""
        return answer.unwrap().name if answer.ok else ""

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        """Return the appliance's answer. Raises `NotRunningError`."""
        line = encode_request(request)
        path = self.state / ADMIN_SOCKET
        if not self.state.is_dir():
            raise self._absent("no such directory; give the appliance's state directory with --state")
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
                sock.settimeout(self._seconds)
                sock.connect(str(path))
                sock.sendall(line + b"\n")
                if self._tells:
                    self._say_that_it_starts(sock)
                answer = self._read(sock)
        except FileNotFoundError:
            raise self._absent(
                "no appliance is running with this state directory; start it:"
                " systemctl start rosrv (the package's service), or rosrv up"
            ) from None
        except PermissionError:
            raise AccessDeniedError(f"{path}: only its owner and root have access; use sudo") from None
        except ConnectionRefusedError:
            raise self._absent("the appliance that used this state directory has stopped") from None
        except TimeoutError:
            text = f"{path}: the appliance did not answer within {self._seconds:g} s"
            raise NotRunningError(f"{text}; {UNKNOWN}") from None
        except ConnectionError as error:
            text = str(error) if error.errno is None else f"the appliance ended before it answered; {UNKNOWN}"
            raise NotRunningError(f"{path}: {text}") from None
        except OSError as error:
            raise NotRunningError(f"{path}: {error.strerror or error}") from error
        try:
            return decode(answer, request)
        except ValueError as error:
            raise NotRunningError(f"{path}: an appliance of another version answers: {error}") from None

    def _absent(self, reason: str) -> NotRunningError:
        return NotRunningError(f"{self.state}: {starting(self.state) or reason}")

    def _say_that_it_starts(self, sock: socket.socket) -> None:
        """Wait a second for the answer; then print that it waits, if no process has read the request during a start."""
        answers = select.poll()  # unlike `select`, for any number of open files
        answers.register(sock, select.POLLIN)
        if answers.poll(_PATIENCE_SECONDS * 1000):
            return
        unread = struct.unpack("i", fcntl.ioctl(sock, termios.TIOCOUTQ, bytes(4)))[0]
        age = starting_for(self.state) if unread else None
        if age is not None:
            typer.echo(
                f"rosrv: the appliance is starting, for {age:.0f} s now: waiting for its answer", err=True
            )

    def _read(self, sock: socket.socket) -> bytes:
        line = bytearray()
        try:
            _read_line(sock, line)
        except TimeoutError:
            sock.shutdown(socket.SHUT_WR)
            sock.settimeout(self._grace)
            _read_line(sock, line)
        return bytes(line)


def encode_request(request: AdminRequest[object]) -> bytes:
    """Return the request's bytes. Raises `NotRunningError` for text that is not valid UTF-8, and for huge numbers."""
    try:
        msgspec.msgpack.encode(request)  # JSON would also take numbers of more than 64 bits
        return msgspec.json.encode(request)
    except OverflowError:
        raise NotRunningError("a number of this command has more than 64 bits: give a smaller one") from None
    except UnicodeEncodeError as error:
        word = error.object[max(0, error.start - 20) : error.end + 20]
        shown = word.encode("utf-8", "backslashreplace").decode()
        raise NotRunningError(f"'{shown}' is not valid UTF-8") from None


def _read_line(sock: socket.socket, line: bytearray) -> None:
    while not line.endswith(b"\n"):
        piece = sock.recv(65536)
        if not piece:
            raise ConnectionResetError(f"the appliance closed the connection without an answer; {UNKNOWN}")
        line += piece
