"""The health check of a container, `python -m appliance.cli.healthy`: exit status 0 while nodes are served.

What a person should look at, but nodes do not notice (a certificate that ends soon), is for `rosrv status`: an engine
that restarts what is unhealthy would only make it worse. Run every few seconds, so it loads next to nothing: a tenth
of what the command `rosrv` takes.
"""

import os
import sys
from pathlib import Path

from appliance.channel.admin import StatusWanted
from appliance.channel.status_summary import unserved
from appliance.cli.admin_client import AdminSocket, NotRunningError

_STATE = "/var/lib/rosrv"  # the default of the configuration's key `state`
_SECONDS = 4.0


def main() -> None:
    """Say what is wrong, if anything, and end with 1 then."""
    state = Path(os.environ.get("ROSRV_STATE", _STATE))
    try:
        answer = AdminSocket(state, _SECONDS).ask(StatusWanted())
        reason = unserved(answer.given()) if answer.ok else answer.error
    except NotRunningError as error:
        reason = f"the appliance does not answer: {error}"
    if reason is not None:
        sys.exit(reason)


if __name__ == "__main__":
    main()
