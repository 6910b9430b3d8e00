"""The health check of a container, `python -m appliance.cli.healthy`: exit status 0 while nodes are served.

What a person should look at, but nodes do not notice (a certificate that ends soon), is for `rosrv status`: an engine
that restarts what is unhealthy would only make it worse. Run every few seconds, so it loads next to nothing: a tenth
of what the command `rosrv` takes.
"""

import os
import socket
import sys
from pathlib import Path

import msgspec

from appliance.channel.admin import AdminAnswer, StatusWanted, decode
from appliance.channel.answers.status import Status
from appliance.channel.serving import unserved

_STATE = "/var/lib/rosrv"  # the default of the configuration's key `state`
_SECONDS = 4.0


def main() -> None:
    """Say what is wrong, if anything, and end with 1 then."""
    state = Path(os.environ.get("ROSRV_STATE", _STATE))
    try:
        answer = ask(state / "admin.sock")
        reason = unserved(answer.given()) if answer.ok else answer.error
    except (OSError, msgspec.MsgspecError) as error:
        reason = f"the appliance does not answer: {error}"
    if reason is not None:
        sys.exit(reason)


def ask(path: Path) -> AdminAnswer[Status]:
    """The appliance's status. Raises `OSError` and `msgspec.MsgspecError`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(_SECONDS)
        sock.connect(str(path))
        sock.sendall(msgspec.json.encode(StatusWanted()) + b"\n")
        with sock.makefile("rb") as answer:
            return decode(answer.readline(), StatusWanted())


if __name__ == "__main__":
    main()
