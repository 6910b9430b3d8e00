"""Speaks to the running appliance over the admin socket in its state directory."""

import socket
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from appliance.channel.admin import AdminAnswer, AdminRequest
from appliance.config import Settings

ADMIN_SOCKET = "admin.sock"
DEFAULT_STATE: Path = Settings.model_fields["state"].default
State = Annotated[
    Path,
    typer.Option(
        "--state",
        envvar="ROSRV_STATE",
        help="State directory of the running appliance",
        readable=False,  # it may be passed through, not looked into; who may not connect is told so below
    ),
]
_SECONDS = 30.0


class NotRunningError(Exception):
    """No appliance answers at this state directory; the text says what to do."""


def ask(state: Path, request: AdminRequest) -> AdminAnswer:
    """Ask the running appliance one thing. Raises `NotRunningError`."""
    path = state / ADMIN_SOCKET
    if not state.is_dir():
        raise NotRunningError(
            f"{state}: no such directory; give the appliance's state directory with --state"
        )
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.settimeout(_SECONDS)
            sock.connect(str(path))
            sock.sendall(msgspec.json.encode(request) + b"\n")
            line = _read_line(sock)
    except FileNotFoundError:
        raise NotRunningError(
            f"{state}: no appliance runs with this state directory; start it: rosrv up"
        ) from None
    except PermissionError:
        raise NotRunningError(f"{path} is for its owner and root only; run this as one of them") from None
    except ConnectionRefusedError:
        raise NotRunningError(f"{state}: the appliance that used this state directory has ended") from None
    except TimeoutError:
        raise NotRunningError(f"{path}: the appliance did not answer within {_SECONDS:g} s") from None
    except OSError as error:
        raise NotRunningError(f"{path}: {error.strerror or error}") from error
    return msgspec.json.decode(line, type=AdminAnswer)


def _read_line(sock: socket.socket) -> bytes:
    line = bytearray()
    while not line.endswith(b"\n"):
        piece = sock.recv(65536)
        if not piece:
            raise ConnectionResetError("the appliance closed the connection before it answered")
        line += piece
    return bytes(line)


def body_or_exit(answer: AdminAnswer, *, as_json: bool) -> dict[str, Any]:
    """The answer's body; a refusal is shown whole and ends the program with status 1."""
    if answer.ok:
        return answer.body
    if as_json:
        typer.echo(msgspec.json.encode({"error": answer.error, "findings": answer.findings}).decode())
    else:
        for finding in answer.findings:
            typer.echo(finding, err=True)
        typer.echo(f"rosrv: {answer.error}", err=True)
    raise typer.Exit(1)


def ask_or_exit(state: Path, request: AdminRequest, *, as_json: bool) -> dict[str, Any]:
    """Ask the running appliance; the answer's body. Ends the program with 1 when it refuses, 2 when none runs."""
    try:
        return body_or_exit(ask(state, request), as_json=as_json)
    except NotRunningError as error:
        typer.echo(f"rosrv: {error}", err=True)
        raise typer.Exit(2) from None
