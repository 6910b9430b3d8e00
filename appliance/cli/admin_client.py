"""Asks the running appliance over the admin socket in its state directory, which is for its owner and root."""

import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from appliance.channel.admin import A, AdminAnswer, AdminRequest, decode

if TYPE_CHECKING:
    from appliance.cli.audit.source import FileLog

ADMIN_SOCKET = "admin.sock"
SECONDS = 60.0
"""How long an answer may take: longer than control's slowest, a host that waits for charon, a set that is compiled."""


_GRACE_SECONDS = 10.0
UNKNOWN = (
    "an order may have taken effect; if it has not by now, it never will. What took effect:"
    " rosrv audit search --since 5m"
)


class NotRunningError(Exception):
    """No appliance can be asked at this place, or not by this user or token; the text says what to do."""


class AdminSocket:
    """The appliance that runs with a state directory; an answer may take so many seconds."""

    def __init__(self, state: Path, seconds: float = SECONDS) -> None:
        self.state = state
        self._seconds = seconds

    def audit(self) -> "FileLog":
        """The audit log's file, which can be read without a running appliance."""
        from appliance.cli.audit.source import FileLog  # noqa: PLC0415  only for the verbs that read it

        return FileLog(self.state)

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        """Ask the running appliance one thing. Raises `NotRunningError`."""
        line = encoded(request)
        path = self.state / ADMIN_SOCKET
        if not self.state.is_dir():
            raise NotRunningError(
                f"{self.state}: no such directory; give the appliance's state directory with --state"
            )
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
                sock.settimeout(self._seconds)
                sock.connect(str(path))
                sock.sendall(line + b"\n")
                answer = self._read(sock)
        except FileNotFoundError:
            raise NotRunningError(
                f"{self.state}: no appliance runs with this state directory; start it: rosrv up"
            ) from None
        except PermissionError:
            raise NotRunningError(f"{path} is for its owner and root only; run this as one of them") from None
        except ConnectionRefusedError:
            raise NotRunningError(
                f"{self.state}: the appliance that used this state directory has ended"
            ) from None
        except TimeoutError:
            text = f"{path}: the appliance did not answer within {self._seconds:g} s"
            raise NotRunningError(f"{text}; {UNKNOWN}") from None
        except OSError as error:
            raise NotRunningError(f"{path}: {error.strerror or error}") from error
        try:
            return decode(answer, request)
        except msgspec.MsgspecError as error:
            raise NotRunningError(f"{path}: an appliance of another version answers: {error}") from None

    def _read(self, sock: socket.socket) -> bytes:
        """Return the answer; when it does not come in time, withdraw the request and wait for what became of it."""
        line = bytearray()
        try:
            _read_line(sock, line)
        except TimeoutError:
            sock.shutdown(socket.SHUT_WR)
            sock.settimeout(_GRACE_SECONDS)
            _read_line(sock, line)
        return bytes(line)


def encoded(request: AdminRequest[Any]) -> bytes:
    """The request as it is sent. Raises `NotRunningError` for words that no appliance can be asked for."""
    try:
        return msgspec.json.encode(request)
    except UnicodeEncodeError as error:
        word = error.object[max(0, error.start - 20) : error.end + 20]
        shown = word.encode("utf-8", "backslashreplace").decode()
        raise NotRunningError(f"'{shown}' is not UTF-8: write it anew in that encoding") from None


def _read_line(sock: socket.socket, line: bytearray) -> None:
    """Read the rest of a line."""
    while not line.endswith(b"\n"):
        piece = sock.recv(65536)
        if not piece:
            raise ConnectionResetError(f"the appliance closed the connection before it answered; {UNKNOWN}")
        line += piece
