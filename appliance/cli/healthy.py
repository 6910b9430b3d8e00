"""The health check of a container, `python -m appliance.cli.healthy`: exit status 0 while nodes are served.

What a person should look at, but nodes do not notice (a certificate that ends soon), is for `rosrv status`: an engine
that restarts what is unhealthy would only make it worse. Run every few seconds, so it loads next to nothing: a tenth
of what the command `rosrv` takes.
"""

import os
import socket
import sys
from pathlib import Path
from typing import Any

import msgspec

from appliance.channel.admin import AdminAnswer, StatusWanted

_STATE = "/var/lib/rosrv"  # the default of the configuration's key `state`
_SECONDS = 4.0


def main() -> None:
    """Say what is wrong, if anything, and end with 1 then."""
    state = Path(os.environ.get("ROSRV_STATE", _STATE))
    try:
        reason = unserved(ask(state / "admin.sock"))
    except (OSError, msgspec.MsgspecError) as error:
        reason = f"the appliance does not answer: {error}"
    if reason is not None:
        sys.exit(reason)


def ask(path: Path) -> AdminAnswer:
    """The appliance's status. Raises `OSError` and `msgspec.MsgspecError`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(_SECONDS)
        sock.connect(str(path))
        sock.sendall(msgspec.json.encode(StatusWanted()) + b"\n")
        with sock.makefile("rb") as answer:
            return msgspec.json.decode(answer.readline(), type=AdminAnswer)


def no_relay(presence: str) -> str:
    """What it means that not every relay process is there."""
    if presence == "away":
        return "no relay process: topics and services carry nothing"
    return f"of the relay processes {presence}: their topics and services carry nothing"


def unserved(answer: AdminAnswer) -> str | None:
    """Why nodes are not served now; None when they are."""
    if not answer.ok:
        return answer.error
    body: dict[str, Any] = answer.body
    if body["probe"] not in ("", "passed"):
        return f"the ROS Master is not hidden: {body['probe']}"
    if body["audit"]["failed"]:
        return f"the audit log cannot be written: {body['audit']['failed']}"
    if body["relay"] != "connected":
        return no_relay(body["relay"])
    return None if body["rosmaster"] == "reachable" else "the ROS Master is being rebuilt: calls wait"


if __name__ == "__main__":
    main()
